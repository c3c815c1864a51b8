// What the page asks of the daemon: requests, events and frames, all by fetch, so that the token can
// go with each of them.

let token = sessionStorage.getItem("fbard-token") ?? "";
let askForToken = null; // a promise while the user is being asked
let asker = async () => "";

export function onToken(ask) {
  asker = ask;
}

// An answer that is not a success (RFC 9457).
export class Problem extends Error {
  constructor(status, body) {
    super(body?.detail ?? `the daemon answered ${status}`);
    this.status = status;
    this.errors = body?.errors ?? [];
    this.more = body?.more_errors ?? 0;
  }
}

async function newToken(refused) {
  askForToken ??= asker(refused).finally(() => {
    askForToken = null;
  });
  token = await askForToken;
  sessionStorage.setItem("fbard-token", token);
}

// The response, once it is a success. Throws Problem, TypeError (nobody answers) or AbortError.
export async function ask(method, path, { body, text, headers = {}, signal } = {}) {
  for (;;) {
    const used = token;
    const all = { ...headers };
    if (used) all.Authorization = `Bearer ${used}`;
    if (body !== undefined || text !== undefined) all["Content-Type"] = "application/json";
    const response = await fetch(path, {
      method,
      headers: all,
      body: text ?? (body === undefined ? undefined : JSON.stringify(body)),
      signal,
      cache: "no-store",
      credentials: "omit",
    });
    if (response.ok) return response;
    if (response.status === 401) {
      if (used === token) await newToken(used !== "");
      continue;
    }
    let problem = null;
    try {
      problem = await response.json();
    } catch {
      // not from fbard, or cut off: the status says enough
    }
    throw new Problem(response.status, problem);
  }
}

export async function get(path, options) {
  return (await ask("GET", path, options)).json();
}

// Calls tell(kind, data) for each server-sent event until the stream ends; beat() with whatever comes.
export async function listen(path, { signal, opened, tell, beat }) {
  const response = await ask("GET", path, { signal, headers: { Accept: "text/event-stream" } });
  const reader = response.body.getReader();
  const decoder = new TextDecoder();
  let rest = "";
  opened();
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    beat();
    rest += decoder.decode(value, { stream: true });
    const blocks = rest.split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      let kind = "message";
      let data = "";
      for (const line of block.split("\n")) {
        if (line.startsWith("event: ")) kind = line.slice(7);
        else if (line.startsWith("data: ")) data += line.slice(6);
      }
      if (data) tell(kind, JSON.parse(data));
    }
  }
}

const PREAMBLE = 64;

// Frames of a stream, back to back, each as an ArrayBuffer of its own.
export async function* frames(path, { signal }) {
  const response = await ask("GET", path, { signal });
  const reader = response.body.getReader();
  const head = new Uint8Array(PREAMBLE);
  let frame = null;
  let filled = 0;
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    let at = 0;
    while (at < value.length) {
      const into = frame ?? head;
      const n = Math.min(value.length - at, into.length - filled);
      into.set(value.subarray(at, at + n), filled);
      at += n;
      filled += n;
      if (filled < into.length) continue;
      if (frame === null) {
        const total = Number(new DataView(head.buffer).getBigUint64(16, true));
        frame = new Uint8Array(total);
        frame.set(head);
        filled = PREAMBLE;
        continue;
      }
      yield frame.buffer;
      frame = null;
      filled = 0;
    }
  }
}
