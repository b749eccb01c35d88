// The server's JSON, with the key that a person entered. The key is kept in this tab's session, and in no other place.

const TRIES = 4;
const STUDIO = 60000; // what the studio has begun goes on: it is asked again until it is done
const LONGEST_WAIT = 5000;
const SILENCE = 10000; // a stream sends a comment every two seconds

/** What went wrong, in the server's words. `code` is stable; `network` where the server could not be reached. */
export class Fault extends Error {
  constructor(status, code, message, wait = null) {
    super(message);
    Object.assign(this, { status, code, wait });
  }
}

export const key = {
  get: () => sessionStorage.getItem("key"),
  set(text) {
    if (text) sessionStorage.setItem("key", text);
    else sessionStorage.removeItem("key");
    declined = false;
  },
};

let prompt = async () => false;
let asking = null;
let declined = false;

/** `handler(sentence)` asks a person for a key and resolves to whether there is a new one. */
export function onKeyNeeded(handler) {
  prompt = handler;
}

/** One dialog for all requests that wait for a key. */
function newKey(sentence) {
  asking ??= prompt(sentence).finally(() => { asking = null; });
  return asking;
}

/**
 * The answer to a request: JSON, or the response itself where `whole`. Throws a Fault, or what `signal` was aborted with.
 * What may be repeated is repeated while the server is busy; a change carries a name of its own, and is applied once.
 */
export async function ask(path, { method = "GET", body, signal, whole = false, repeatable = method === "GET" } = {}) {
  const headers = { accept: whole ? "*/*" : "application/json" };
  if (body !== undefined) headers["content-type"] = "application/json";
  if (!repeatable) headers["idempotency-key"] = unique();
  const begun = Date.now();
  for (let attempt = 1; ; attempt += 1) {
    const used = key.get();
    try {
      const response = await reply(path, { method, body: body && JSON.stringify(body), signal, headers }, used);
      return whole ? response : await response.json();
    } catch (fault) {
      if (!(fault instanceof Fault)) throw fault;
      if (fault.status === 401) {
        if (key.get() !== used) continue; // another request has asked meanwhile
        if (declined && repeatable) throw fault;
        if (await newKey(used ? fault.message : "This needs an API key.")) continue;
        declined = true;
        throw fault;
      }
      const isGoingOn = fault.code === "not_ready" && Date.now() - begun < STUDIO;
      if (!isGoingOn && (attempt >= TRIES || !passes(fault, repeatable))) throw fault;
      await pause(Math.min(LONGEST_WAIT, fault.wait ?? 300 * 2 ** attempt), signal);
    }
  }
}

/** Whether it may be otherwise in a moment: a server that is starting, moving, or busy. */
export function passes(fault, repeatable) {
  return fault.code === "network" || [502, 503, 504].includes(fault.status) || (repeatable && fault.status === 429);
}

async function reply(path, request, text) {
  const headers = text ? { ...request.headers, authorization: `Bearer ${text}` } : request.headers;
  let response;
  try {
    response = await fetch(path, { ...request, headers, cache: "no-store", redirect: "error" });
  } catch (error) {
    if (request.signal?.aborted) throw error;
    throw new Fault(0, "network", "The server does not answer.");
  }
  if (response.ok) return response;
  const wait = 1000 * Number(response.headers.get("retry-after")) || null;
  const said = await response.json().catch(() => ({}));
  throw new Fault(response.status, said.code ?? "http_error", said.message ?? `The server answered ${response.status}.`, wait);
}

/**
 * Follow server-sent events: `heard(name, document)` for each. Begins again whenever the stream ends, until the function
 * that is returned is called. A hidden tab does not listen: a browser has few connections for one server.
 */
export function follow(path, heard, { ends = () => false } = {}) {
  const closed = new AbortController();
  (async () => {
    for (let failures = 0; !closed.signal.aborted; ) {
      await visible(closed.signal);
      const listening = new AbortController();
      const stop = () => (document.hidden || closed.signal.aborted) && listening.abort();
      document.addEventListener("visibilitychange", stop);
      closed.signal.addEventListener("abort", stop);
      try {
        const response = await ask(path, { signal: listening.signal, whole: true });
        for await (const [name, data] of messages(response.body, listening)) {
          failures = 0;
          heard(name, data);
          if (ends(name, data)) return;
        }
      } catch (error) {
        if (error instanceof Fault && [401, 403, 404].includes(error.status)) return; // the page itself says why
        failures += 1;
      } finally {
        document.removeEventListener("visibilitychange", stop);
        closed.signal.removeEventListener("abort", stop);
      }
      await pause(Math.min(15000, 500 * 2 ** failures), closed.signal).catch(() => {});
    }
  })().catch(() => {}); // closed while it waited
  return () => closed.abort();
}

/** The events of a stream: pairs of a name and the parsed data. */
async function* messages(body, listening) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let rest = "";
  for (;;) {
    const patience = setTimeout(() => listening.abort(), SILENCE);
    const { value, done } = await reader.read().finally(() => clearTimeout(patience));
    if (done) return;
    const blocks = (rest + value).replaceAll("\r\n", "\n").split("\n\n");
    rest = blocks.pop();
    for (const block of blocks) {
      const fields = block.split("\n").map((line) => line.match(/^(event|data): ?(.*)$/)).filter(Boolean);
      const text = fields.filter(([, name]) => name === "data").map(([, , words]) => words).join("\n");
      if (text) yield [fields.find(([, name]) => name === "event")?.[2] ?? "message", JSON.parse(text)];
    }
  }
}

function visible(signal) {
  if (!document.hidden) return Promise.resolve();
  return new Promise((go) => {
    const look = () => {
      if (document.hidden && !signal.aborted) return;
      document.removeEventListener("visibilitychange", look);
      signal.removeEventListener("abort", look);
      go();
    };
    document.addEventListener("visibilitychange", look);
    signal.addEventListener("abort", look);
  });
}

function pause(milliseconds, signal) {
  return new Promise((go, stop) => {
    const timer = setTimeout(go, milliseconds);
    signal?.addEventListener("abort", () => { clearTimeout(timer); stop(signal.reason); }, { once: true });
  });
}

/** A name for one change. (`crypto.randomUUID` is for secure contexts, which a server in a local network is not.) */
const unique = () => Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");

/** A path with a query; what is null, undefined or empty is left out. */
export function query(path, parameters) {
  const set = Object.entries(parameters).filter(([, value]) => value != null && value !== "");
  return set.length ? `${path}?${new URLSearchParams(set)}` : path;
}

/** A path of the API below a league. */
export const of = (league, ...parts) => ["/v1/leagues", league, ...parts].map((part, at) => (at ? encodeURIComponent(part) : part)).join("/");
