/** An HTTP server that returns prepared answers in order, then the last one repeatedly. */

import { createServer, type IncomingHttpHeaders, type Server } from "node:http";
import type { AddressInfo } from "node:net";

/** In place of a status: close the connection without a response, or do not respond. */
export const DROP = 0;
export const NO_RESPONSE = 1;

export interface Answer {
  status: number;
  body?: unknown;
  headers?: Record<string, string>;
}

export const ACTED = { action: 4, model: "board", version: 1, sha256: "0" };

export class PreparedServer {
  readonly requests: { method: string; path: string; body: string; headers: IncomingHttpHeaders }[] = [];
  answers: Answer[] = [];
  readonly #server: Server;

  private constructor() {
    this.#server = createServer(async (request, response) => {
      let body = "";
      for await (const part of request) body += part;
      this.requests.push({ method: request.method ?? "", path: request.url ?? "", body, headers: request.headers });
      const answer = (this.answers.length > 1 ? this.answers.shift() : this.answers[0]) ?? { status: 500 };
      if (answer.status === NO_RESPONSE) return;
      if (answer.status === DROP) {
        request.socket.destroy();
        return;
      }
      response.writeHead(answer.status, { "content-type": "application/json", ...answer.headers });
      response.end(typeof answer.body === "string" ? answer.body : JSON.stringify(answer.body));
    });
  }

  static async start(...answers: Answer[]): Promise<PreparedServer> {
    const server = new PreparedServer();
    server.answers = answers;
    await new Promise<void>((resolve) => server.#server.listen(0, "127.0.0.1", resolve));
    return server;
  }

  get url(): string {
    return `http://127.0.0.1:${(this.#server.address() as AddressInfo).port}`;
  }

  async stop(): Promise<void> {
    this.#server.closeAllConnections();
    await new Promise((resolve) => this.#server.close(resolve));
  }
}

/** An error in the format of the server. */
export function failure(status: number, code: string, headers: Record<string, string> = {}): Answer {
  return { status, body: { code, message: "no" }, headers };
}
