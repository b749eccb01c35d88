/** The errors of the client. */

/** What an error tells besides its message. */
export interface ErrorDetails {
  /** Stable error code of the server, such as `unknown_version`. */
  code?: string;
  /** HTTP status of the response; undefined if the client itself found the error. */
  status?: number | undefined;
  /** The error that caused this one. */
  cause?: unknown;
}

/** Base class. The message is one sentence for people; `code` is stable. */
export class LeagueError extends Error {
  /** Stable error code, such as `unknown_version`. */
  readonly code: string;
  /** HTTP status of the response; undefined if the client itself found the error. */
  readonly status: number | undefined;

  constructor(message: string, { code = "league_error", status, cause }: ErrorDetails = {}) {
    super(message, { cause });
    this.name = new.target.name;
    this.code = code;
    this.status = status;
  }
}

/** An argument, an observation or a state is invalid (400, 408, 413, 415, 422). */
export class InvalidInput extends LeagueError {
  constructor(message: string, details: ErrorDetails = {}) {
    super(message, { code: "invalid_input", ...details });
  }
}

/** An API key is missing or invalid (401). */
export class Unauthenticated extends LeagueError {}

/** The API key lacks the required scope, or the page may not use the server (403). */
export class Forbidden extends LeagueError {}

/** A league, version, alias, policy or evaluation does not exist (404). */
export class NotFound extends LeagueError {}

/** The files of a version were removed (410), or an episode cannot continue because its version is gone. */
export class VersionRetired extends NotFound {
  constructor(message: string, details: ErrorDetails = {}) {
    super(message, { code: "version_retired", ...details });
  }
}

/** The current state differs from the one that the request assumes, for example because an alias was moved (409). */
export class Conflict extends LeagueError {}

/** The server has too many requests, or the API key exceeded its rate (429). */
export class Overloaded extends LeagueError {
  /** Milliseconds after which the server accepts the next request. */
  readonly retryAfter: number;

  constructor(message: string, retryAfter: number, details: ErrorDetails = {}) {
    super(message, details);
    this.retryAfter = retryAfter;
  }
}

/** A policy exists but is not served yet, or no replica accepts requests (503). */
export class NotReady extends LeagueError {
  constructor(message: string, details: ErrorDetails = {}) {
    super(message, { code: "not_ready", ...details });
  }
}

/** A request was not answered within its timeout (504). */
export class DeadlineExceeded extends LeagueError {}

/** The server is unreachable or failed (500, 502). */
export class RemoteError extends LeagueError {
  constructor(message: string, details: ErrorDetails = {}) {
    super(message, { code: "remote_error", ...details });
  }
}

const BY_STATUS: Record<number, new (message: string, details: ErrorDetails) => LeagueError> = {
  401: Unauthenticated,
  403: Forbidden,
  404: NotFound,
  409: Conflict,
  410: VersionRetired,
  503: NotReady,
  504: DeadlineExceeded,
};

/** Returns the error for a response of the server with a `code` and a `message`. `retryAfter`: milliseconds. */
export function errorOf(status: number, code: string, message: string, retryAfter: number): LeagueError {
  if (status === 429) return new Overloaded(message, retryAfter, { code, status });
  const kind = BY_STATUS[status] ?? (status < 500 ? InvalidInput : RemoteError);
  return new kind(message, { code, status });
}

/** Returns the error for an episode or a stream whose version is gone; undefined for another error. */
export function interrupted(error: unknown, what: string): VersionRetired | undefined {
  const codes = ["version_retired", "unknown_version", "artifact_corrupt"];
  if (!(error instanceof LeagueError && codes.includes(error.code))) return undefined;
  const { status } = error;
  return new VersionRetired(`${what} cannot continue: ${error.message}`, { status, cause: error });
}
