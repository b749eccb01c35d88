/** One WebSocket connection, with one message and its response at a time. */

import { InvalidInput, LeagueError, RemoteError, Unauthenticated } from "./errors.js";
import { ConnectionLost, Reply } from "./retries.js";

/** What a stream uses of a `WebSocket`. The classes of browsers, of Node.js and of the package `ws` have it. */
export interface WebSocketLike {
  binaryType: string;
  readonly readyState: number;
  send(data: string | Uint8Array): void;
  close(): void;
  addEventListener(type: "open" | "error" | "close", listener: () => void): void;
  addEventListener(type: "message", listener: (event: { data: unknown }) => void): void;
  addEventListener(type: "close", listener: (event: { code: number; reason: string }) => void): void;
}

/** The class of a `WebSocket`. Its type is open because each implementation has its own types of events. */
export type WebSocketConstructor = new (url: string, protocols?: string[]) => any;

/** Returns the class of a `WebSocket`, by default the global one. Throws InvalidInput if there is none. */
export function webSocketClass(option: WebSocketConstructor | undefined): WebSocketConstructor {
  const kind = option ?? (globalThis as { WebSocket?: WebSocketConstructor }).WebSocket;
  if (kind) return kind;
  throw new InvalidInput(
    "there is no WebSocket: use Node.js 22, node --experimental-websocket, or the option WebSocket of the client",
  );
}

/** A connection that was never opened. */
export class Refused extends ConnectionLost {}

const OPEN = 1;

/** An open connection. */
export class Connection {
  readonly #socket: WebSocketLike;
  #waiting: { resolve: (reply: Reply) => void; reject: (error: unknown) => void } | undefined;
  #closed: LeagueError | ConnectionLost | undefined;

  private constructor(socket: WebSocketLike) {
    this.#socket = socket;
    socket.addEventListener("message", ({ data }) => {
      const reply = Reply.ofMessage(data as string | ArrayBuffer);
      // An announcement of the end, which is not a response.
      if (reply.body && "closing" in reply.body) return;
      this.#waiting?.resolve(reply);
    });
    socket.addEventListener("close", ({ code, reason }) => {
      this.#closed = closedError(code, reason);
      this.#waiting?.reject(this.#closed);
    });
    socket.addEventListener("error", () => {}); // the event `close` follows
  }

  /** Opens a connection. Rejects with Refused if the server does not accept it. */
  static open(kind: WebSocketConstructor, url: string, protocols: string[], signal: AbortSignal): Promise<Connection> {
    const socket: WebSocketLike = new kind(url, protocols);
    socket.binaryType = "arraybuffer";
    return new Promise((resolve, reject) => {
      const stop = (): void => {
        socket.close();
        reject(signal.reason);
      };
      signal.addEventListener("abort", stop, { once: true });
      socket.addEventListener("open", () => resolve(new Connection(socket)));
      // Some versions of Node.js send only one of the two.
      for (const type of ["error", "close"] as const) {
        socket.addEventListener(type, () => reject(new Refused("the stream was refused")));
      }
    });
  }

  /** Whether messages can be sent. */
  get isOpen(): boolean {
    return this.#socket.readyState === OPEN;
  }

  /** Sends a message and returns its response. After a rejection the connection must be closed. */
  exchange(message: string | Uint8Array, signal: AbortSignal): Promise<Reply> {
    return new Promise((resolve, reject) => {
      if (signal.aborted) return reject(signal.reason);
      if (this.#closed) return reject(this.#closed);
      this.#waiting = { resolve, reject };
      signal.addEventListener("abort", () => reject(signal.reason), { once: true });
      this.#socket.send(message);
    });
  }

  close(): void {
    this.#waiting = undefined;
    this.#socket.close();
  }
}

/** The error of a connection that was closed: a LeagueError if the same message would fail again. */
function closedError(code: number, reason: string): LeagueError | ConnectionLost {
  const message = `the stream was closed with code ${code}${reason && `: ${reason}`}`;
  if (code === 1008) return new Unauthenticated(message, { code: "unauthenticated" });
  if (code === 1009) return new InvalidInput(message, { code: "body_too_large" });
  if (code === 1002 || code === 1007) return new RemoteError(message);
  return new ConnectionLost(message);
}
