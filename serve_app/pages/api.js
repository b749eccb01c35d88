// JSON requests to the server, with retries and the API key that the user entered. The key is kept in sessionStorage only. In a report, its data answers.

import { heard, unanswered } from "./connection.js";
import { documentOf, report } from "./report.js";
import { ROOT } from "./router.js";

const MAX_ATTEMPTS = 4;
const NOT_READY_TIMEOUT = 60000; // milliseconds; `not_ready` is retried until the evaluation service has finished
const MAX_RETRY_DELAY = 5000;
const RESPONSE_TIMEOUT = 8000; // milliseconds until the headers; the server responds within five seconds

/** A failed request, with the server's message. `code` is stable; it is `network` if the server could not be reached. */
export class ApiError extends Error {
  constructor(status, code, message, retryAfter = null) {
    super(message);
    Object.assign(this, { status, code, retryAfter });
  }
}

const KEY = `key${ROOT}`; // other servers of the same origin, below other prefixes, have keys of their own

export const key = {
  get: () => (report ? null : sessionStorage.getItem(KEY)),
  set(text) {
    if (text) sessionStorage.setItem(KEY, text);
    else sessionStorage.removeItem(KEY);
    promptDeclined = false;
  },
};

let promptForKey = async () => false;
let pendingPrompt = null;
let promptDeclined = false;

/** `handler(message)` prompts the user for a key and resolves to whether a new key was entered. */
export function onKeyNeeded(handler) {
  promptForKey = handler;
}

/** All requests that need a key share one dialog. */
function newKey(message) {
  pendingPrompt ??= promptForKey(message).finally(() => { pendingPrompt = null; });
  return pendingPrompt;
}

/**
 * Send a request. Returns the parsed JSON, or the response itself if `raw`. Throws ApiError, or the abort reason of `signal`.
 * Repeatable requests are retried while the server is busy. Other requests carry an idempotency key, so they are applied once.
 */
export async function request(path, { method = "GET", body, signal, raw = false, repeatable = method === "GET" } = {}) {
  if (report) return reported(path);
  const headers = { accept: raw ? "*/*" : "application/json" };
  if (body !== undefined) headers["content-type"] = "application/json";
  if (!repeatable) headers["idempotency-key"] = randomId();
  const startedAt = Date.now();
  for (let attempt = 1; ; attempt += 1) {
    const usedKey = key.get();
    try {
      const response = await send(path, { method, body: body && JSON.stringify(body), signal, headers }, usedKey);
      return raw ? response : await response.json();
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      if (error.status === 401) {
        if (key.get() !== usedKey) continue; // another request has prompted in the meantime
        if (promptDeclined && repeatable) throw error;
        if (await newKey(usedKey ? error.message : "This request requires an API key.")) continue;
        promptDeclined = true;
        throw error;
      }
      const isInProgress = error.code === "not_ready" && Date.now() - startedAt < NOT_READY_TIMEOUT;
      if (!isInProgress && (attempt >= MAX_ATTEMPTS || !isTemporary(error, repeatable))) throw error;
      await pause(Math.min(MAX_RETRY_DELAY, error.retryAfter ?? 300 * 2 ** attempt), signal);
    }
  }
}

/** The document of a path in the report. Throws ApiError if there is none, or if the server would have responded with an error. */
function reported(path) {
  const found = documentOf(path) ?? { code: "not_found", message: "This report does not contain it." };
  if (found.code) throw new ApiError(404, found.code, found.message);
  return found;
}

/** Whether a retry may succeed: the server is starting, restarting or busy. */
export function isTemporary(error, repeatable) {
  return error.code === "network" || [502, 503, 504].includes(error.status) || (repeatable && error.status === 429);
}

async function send(path, options, apiKey) {
  const headers = apiKey ? { ...options.headers, authorization: `Bearer ${apiKey}` } : options.headers;
  const late = new AbortController();
  const timer = setTimeout(() => late.abort(), RESPONSE_TIMEOUT);
  const signal = options.signal ? AbortSignal.any([options.signal, late.signal]) : late.signal;
  let response;
  try {
    response = await fetch(ROOT + path, { ...options, headers, signal, cache: "no-store", redirect: "error" });
  } catch (error) {
    if (options.signal?.aborted) throw error;
    unanswered();
    throw new ApiError(0, "network", "The server is not responding.");
  } finally {
    clearTimeout(timer);
  }
  heard(response.status);
  if (response.ok) return response;
  const retryAfter = 1000 * Number(response.headers.get("retry-after")) || null;
  const body = await response.json().catch(() => ({}));
  throw new ApiError(response.status, body.code ?? "http_error", body.message ?? `The server returned status ${response.status}.`, retryAfter);
}

/** Throw ApiError if the server rejects a key. */
export async function checkKey(text) {
  await send("/v1/key", { headers: { accept: "application/json" } }, text);
}

export function pause(milliseconds, signal) {
  return new Promise((resolve, reject) => {
    const timer = setTimeout(resolve, milliseconds);
    signal?.addEventListener("abort", () => { clearTimeout(timer); reject(signal.reason); }, { once: true });
  });
}

/** A random idempotency key. (`crypto.randomUUID` requires a secure context, which plain HTTP in a local network is not.) */
const randomId = () => Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) => byte.toString(16).padStart(2, "0")).join("");

/** A path with a query string; parameters that are null, undefined or empty are left out. */
export function query(path, parameters) {
  const set = Object.entries(parameters).filter(([, value]) => value != null && value !== "");
  return set.length ? `${path}?${new URLSearchParams(set)}` : path;
}

/** The API path of a league, or of something in it. */
export const apiPath = (league, ...parts) => ["/v1/leagues", league, ...parts].map((part, index) => (index ? encodeURIComponent(part) : part)).join("/");
