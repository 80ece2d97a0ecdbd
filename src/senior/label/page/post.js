// Posts that are made again, unchanged, until the server has answered them.

const PATIENCE = 10_000; // ms that a request may take before it is made again

/** Resolves after so many ms, or as soon as the network is back. */
export function wait(ms) {
  return new Promise((resolve) => {
    setTimeout(resolve, ms);
    addEventListener("online", resolve, { once: true, signal: AbortSignal.timeout(ms) });
  });
}

/** An id for a post. crypto.randomUUID is there in secure contexts only, which http in a local network is not. */
export function newId() {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/**
 * Posts the very same body until there is an answer below 500: {status, data}. `trouble(text)` is called with
 * `wording` after each attempt that came to nothing, and with "" once there is an answer.
 */
export async function post(path, body, wording, trouble) {
  const request = { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) };
  for (let attempt = 0; ; attempt += 1) {
    try {
      const response = await fetch(path, { ...request, signal: AbortSignal.timeout(PATIENCE) });
      if (response.status < 500) {
        const data = await response.json();
        trouble("");
        return { status: response.status, data };
      }
    } catch {
      // no connection, no answer in time, or half an answer: the same post again tells what became of it
    }
    trouble(wording);
    await wait(Math.min(400 * 2 ** attempt, 5000));
  }
}
