// Keys: each counts once however long it is held, and none acts where it is needed by what has the focus.

const IS_MAC = navigator.platform.startsWith("Mac"); // where Option makes a key's third characters

/** The key by its character, not its place, so that it is the one the page shows on every keyboard layout. */
function chord(event) {
  const key = event.key.toLowerCase();
  const character = key.length === 1 && !/\p{L}/u.test(key); // Shift or a third level may be what makes it
  const third = event.getModifierState("AltGraph") || (event.altKey && (event.ctrlKey || IS_MAC));
  if (event.altKey && !(character && third)) return "";
  const control = (event.ctrlKey || event.metaKey) && !(character && third) ? "control+" : "";
  return `${control}${event.shiftKey && !character ? "shift+" : ""}${key}`;
}

function ownKey(target, key) {
  if (target.closest("input:not([type=range]), textarea, select")) return true;
  if (target.matches("[type=range]")) return /^(Arrow|Home|End|Page)/.test(key);
  return (key === " " || key === "Enter") && target.closest("button, a") !== null;
}

/** Calls actions[chord] at the press of a key; `blocked(action)` says whether it must not act now. */
export function connectKeys(actions, blocked) {
  const down = new Set();

  addEventListener("keydown", (event) => {
    if (event.isComposing || !event.key) return; // autofill sends key events without a key
    const held = event.repeat || down.has(event.code);
    if (event.code) down.add(event.code);
    if (ownKey(event.target, event.key)) {
      if (held && event.target.closest("button")) event.preventDefault(); // a held Enter would press it again and again
      return;
    }
    const action = actions[chord(event)];
    if (!action || blocked(action)) return;
    event.preventDefault();
    if (!held) action();
  });

  addEventListener("keyup", (event) => {
    down.delete(event.code);
    if (event.key === "Meta") down.clear(); // macOS tells of no key that is let go while Command is down
  });
  addEventListener("blur", () => down.clear());
}
