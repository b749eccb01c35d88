/**
 * Which failures are temporary, the backoff between attempts, and the retry deadline.
 *
 * Every request is safe to repeat: inference changes nothing, its random choices depend on the seed in the request, and
 * requests that change something carry an `Idempotency-Key`. All times are in milliseconds.
 */

import { errorOf, type LeagueError, RemoteError } from "./errors.js";

/** Before the second attempt; doubled before each further attempt. */
const INITIAL_DELAY = 10;
/** Maximum between attempts, unless the server specifies more. */
const MAX_DELAY = 1000;
/** Relative range of the random variation of delays, which spreads the load of many clients. */
const JITTER = 0.5;
/** How long a request is retried after a server reported that it is not ready. */
const NOT_READY_DEADLINE = 1000;
/** HTTP statuses of an overloaded server or a lost replica. */
const BUSY_STATUSES = [429, 502, 504];

/** A response of the server, or a message of a stream with the status that it states. */
export class Reply {
  /**
   * `retryAfter`: the header Retry-After. `replica`: the replica that answered, if that is known. `body`: the JSON object
   * in the response; undefined if it has another body and is not from a policy server. `bytes`: a binary message.
   */
  constructor(
    readonly status: number,
    readonly text: string,
    readonly retryAfter: string | null = null,
    readonly replica: string | undefined = undefined,
    readonly body = parseObject(text),
    readonly bytes: ArrayBuffer | undefined = undefined,
  ) {}

  /** Returns the reply in a message of a stream. */
  static ofMessage(text: string | ArrayBuffer): Reply {
    if (typeof text !== "string") return new Reply(200, "", null, undefined, {}, text);
    const body = parseObject(text);
    if (!body || !("code" in body)) return new Reply(200, text, null, undefined, body);
    const { status = 500, retry_after: retryAfter = null } = body;
    return new Reply(Number(status), text, retryAfter === null ? null : String(retryAfter), undefined, body);
  }

  /** The minimal delay that a busy server specifies. */
  get minimalDelay(): number {
    return this.status === 429 && /^\d+$/.test(this.retryAfter ?? "") ? 1000 * Number(this.retryAfter) : 0;
  }

  /** The error in the response: RemoteError if it has no `code` and `message`. */
  error(url: string): LeagueError {
    const { code, message } = this.body ?? {};
    if (typeof code === "string" && typeof message === "string") {
      return errorOf(this.status, code, message, this.minimalDelay);
    }
    const { status } = this;
    return new RemoteError(`${url} returned status ${status}: ${this.text.slice(0, 200)}`, { status });
  }
}

/** A connection that was refused or lost, or an attempt that took too long. */
export class ConnectionLost extends Error {}

export type Outcome = Reply | ConnectionLost;

/** The attempts of one request. `deadline`: the time after the first attempt until which the request is retried. */
export class Retries {
  readonly #start = performance.now();
  #delay = INITIAL_DELAY;

  constructor(readonly deadline: number) {}

  /** Returns the time until the next attempt; undefined if the outcome is final. */
  nextDelay(outcome: Outcome): number | undefined {
    const deadline = Math.min(this.deadline, retryDeadline(outcome));
    if (deadline <= 0) return undefined;
    const minimum = outcome instanceof Reply ? outcome.minimalDelay : 0;
    const delay = Math.max(minimum, this.#delay * (1 + JITTER * (2 * Math.random() - 1)));
    this.#delay = Math.min(2 * this.#delay, MAX_DELAY);
    return performance.now() - this.#start + delay <= deadline ? delay : undefined;
  }
}

/** Returns how long a failure is worth retrying: 0, a second, or forever. */
function retryDeadline(outcome: Outcome): number {
  if (!(outcome instanceof Reply) || BUSY_STATUSES.includes(outcome.status)) return Infinity;
  const { status, body } = outcome;
  if (status < 400) return 0;
  // Responses of a proxy that is not configured by this project, or knows no replica yet (404).
  if (body === undefined) return status >= 500 ? Infinity : status === 404 ? NOT_READY_DEADLINE : 0;
  if (body["code"] === "no_replica") return Infinity;
  return status === 503 ? NOT_READY_DEADLINE : 0;
}

/** Returns the response of a successful call. Throws the LeagueError that corresponds to a failure. */
export function checked(outcome: Outcome, url: string): Reply {
  if (!(outcome instanceof Reply)) {
    throw new RemoteError(`${url} cannot be reached: ${outcome.message}`, { cause: outcome });
  }
  if ((outcome.status === 200 || outcome.status === 202) && outcome.body) return outcome;
  throw outcome.error(url);
}

function parseObject(text: string): Record<string, unknown> | undefined {
  try {
    const value: unknown = JSON.parse(text);
    return typeof value === "object" && value !== null && !Array.isArray(value) ? { ...value } : undefined;
  } catch {
    return undefined;
  }
}

/** Waits. Rejects with the reason of `signal` if that is aborted. */
export function sleep(milliseconds: number, signal?: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    signal?.throwIfAborted();
    const stop = (): void => {
      clearTimeout(timer);
      reject(signal?.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", stop);
      resolve();
    }, milliseconds);
    signal?.addEventListener("abort", stop, { once: true });
  });
}
