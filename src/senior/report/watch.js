// Loads the page anew when there is a newer one, at the place that was being read, and tells how things stand.
"use strict";

const VERSION = document.currentScript.dataset.version;
const EVERY = 2000;
const line = document.createElement("div");
line.id = "watch";
line.setAttribute("role", "status");
Object.assign(line.style, {
  position: "fixed", right: "0.7rem", bottom: "0.7rem", padding: "0.3rem 0.7rem", maxWidth: "40rem",
  font: "14px system-ui, sans-serif", color: "#fff", background: "#333", borderRadius: "0.4rem", zIndex: "10",
});

function opened() {
  return [...document.querySelectorAll("details")].map((one) => one.open);
}

function keep() {
  sessionStorage.setItem("watch", JSON.stringify({ x: scrollX, y: scrollY, open: opened() }));
}

function restore() {
  const kept = JSON.parse(sessionStorage.getItem("watch") || "null");
  sessionStorage.removeItem("watch");
  if (!kept) return;
  const all = document.querySelectorAll("details");
  if (all.length === kept.open.length) all.forEach((one, i) => { one.open = kept.open[i]; });
  scrollTo(kept.x, kept.y);
}

async function look() {
  try {
    const answer = await fetch("/version", { cache: "no-store" });
    const now = await answer.json();
    if (now.version !== VERSION) {
      location.reload();
      return;
    }
    line.textContent = now.trouble ? `Not up to date: ${now.trouble}` : `Live, as of ${now.built}`;
    line.hidden = !now.built;
  } catch {
    line.textContent = "senior watch has ended; this is the last page.";
    line.hidden = false;
  }
  setTimeout(look, EVERY);
}

history.scrollRestoration = "manual";
line.hidden = true;
document.body.append(line);
addEventListener("pagehide", keep);
addEventListener("load", () => { restore(); look(); });
