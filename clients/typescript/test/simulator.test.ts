import assert from "node:assert/strict";
import { once } from "node:events";
import { createServer, type Server } from "node:http";
import type { AddressInfo } from "node:net";
import { afterEach, beforeEach, test } from "node:test";
import { Client, InvalidInput, NotFound, type Report, type SimulatedGame } from "policy-league-client";
import { type WebSocket, WebSocketServer } from "ws";

type Message = Record<string, any>;

/** A gateway that accepts simulators, and answers as the test says. */
class GatewayServer {
  readonly hellos: Message[] = [];
  readonly reports: Message[] = [];
  /** Called for each connection that has said hello. */
  opened: (socket: WebSocket) => void = () => {};
  /** Called for each message with reports. */
  reported: (socket: WebSocket, message: Message) => void = () => {};
  /** The number of handshakes to refuse, and the answer to the request that asks why. */
  refusals = 0;
  why: { status: number; body: Message } = { status: 200, body: { simulations: [] } };
  readonly #http: Server;
  readonly #sockets = new WebSocketServer({ noServer: true });

  constructor() {
    this.#http = createServer((_, response) => response.writeHead(this.why.status).end(JSON.stringify(this.why.body)));
    this.#http.on("upgrade", (request, socket, head) => {
      if (this.refusals-- > 0) return socket.end("HTTP/1.1 503 Service Unavailable\r\ncontent-length: 0\r\n\r\n");
      this.#sockets.handleUpgrade(request, socket, head, (simulator) =>
        simulator.on("message", (data) => {
          const message = JSON.parse(String(data)) as Message;
          if (message["type"] === "hello") {
            this.hellos.push(message);
            simulator.send(JSON.stringify({ type: "welcome" }));
            this.opened(simulator);
          } else {
            this.reports.push(message);
            this.reported(simulator, message);
          }
        }),
      );
    });
  }

  async start(): Promise<void> {
    this.#http.listen(0, "127.0.0.1");
    await once(this.#http, "listening");
  }

  get url(): string {
    return `http://127.0.0.1:${(this.#http.address() as AddressInfo).port}`;
  }

  stop(): void {
    this.#sockets.clients.forEach((socket) => socket.terminate());
    this.#http.close();
    this.#http.closeAllConnections();
  }
}

/** Two agents act at once for two steps; observations are the seed and the sum of the actions. */
class Counting implements SimulatedGame<number> {
  static created = 0;
  #steps = 0;
  #sum = 0;
  #seed = 0;

  constructor() {
    Counting.created++;
  }

  reset(seed: number): Report[] {
    this.#steps = this.#sum = 0;
    this.#seed = seed;
    return this.#reports();
  }

  step({ a = 0, b = 0 }: Record<string, number>): Report[] {
    this.#steps++;
    this.#sum += a + b;
    return this.#reports();
  }

  #reports(): Report[] {
    const terminated = this.#steps === 2;
    return ["a", "b"].map((agent) => ({ agent, observation: [this.#seed, this.#sum], reward: this.#sum, terminated }));
  }
}

let server: GatewayServer;

beforeEach(async () => {
  server = new GatewayServer();
  await server.start();
  Counting.created = 0;
});

afterEach(() => server.stop());

const play = (socket: WebSocket, ...episodes: number[]): void =>
  socket.send(JSON.stringify({ type: "play", episodes: episodes.map((episode) => ({ episode, seed: 10 * episode })) }));

/** Gives every agent that must act the action 1. */
function act(socket: WebSocket, { reports }: Message): void {
  const acting = (reports as Message[]).filter(({ terminated }) => !terminated);
  const actions = acting.map(({ episode, agent }) => ({ episode, agent, action: 1 }));
  if (actions.length) socket.send(JSON.stringify({ type: "actions", actions }));
}

const simulate = (options: { limit?: number; episodes?: number; signal?: AbortSignal } = {}): Promise<void> =>
  new Client(server.url, { key: "plk_1" }).simulate("game", () => new Counting(), {
    name: "counting",
    version: "2",
    ...options,
  });

test("episodes are played until the limit", async () => {
  server.opened = (socket) => play(socket, 1, 2);
  server.reported = act;
  await simulate({ limit: 2, episodes: 2 });
  assert.deepEqual(server.hellos[0]?.["simulator"], { name: "counting", version: "2" });
  assert.equal(server.hellos[0]?.["episodes"], 2);
  const last = server.reports.at(-1) as Message;
  assert.deepEqual(last["over"], [1, 2].filter((episode) => last["over"].includes(episode)));
  const first = server.reports.flatMap(({ reports }) => reports as Message[]).filter(({ episode }) => episode === 1);
  assert.deepEqual(first.at(-1), { episode: 1, agent: "b", observation: [10, 4], reward: 4, terminated: true });
  assert.equal(first.length, 6);
});

test("a lost connection is opened again, and games are used again", async () => {
  let isFirst = true;
  server.opened = (socket) => play(socket, 1);
  server.reported = (socket, message) => {
    if (isFirst) socket.terminate();
    else act(socket, message);
    isFirst = false;
  };
  await simulate({ limit: 1 });
  assert.equal(server.hellos.length, 2);
  assert.equal(Counting.created, 1);
});

test("an abandoned episode is not continued", async () => {
  server.opened = (socket) => play(socket, 1);
  server.reported = (socket, message) => {
    if (message["reports"][0].episode === 1) {
      socket.send(JSON.stringify({ type: "abandon", episodes: [1] }));
      act(socket, message);
      play(socket, 2);
    } else {
      act(socket, message);
    }
  };
  await simulate({ limit: 1 });
  const episodes = server.reports.flatMap(({ reports }) => reports as Message[]).map(({ episode }) => episode);
  assert.equal(episodes.filter((episode) => episode === 1).length, 2);
});

test("it waits while nothing needs episodes", async () => {
  server.refusals = 1;
  server.opened = (socket) => play(socket, 1);
  server.reported = act;
  await simulate({ limit: 1 });
  assert.equal(server.hellos.length, 1);
});

test("a refused simulator rejects with the reason", async () => {
  server.refusals = 1;
  server.why = { status: 404, body: { code: "unknown_league", message: "there is no league 'game'" } };
  await assert.rejects(simulate(), (error) => error instanceof NotFound && error.code === "unknown_league");
});

test("an invalid report rejects with the reason", async () => {
  server.opened = (socket) => play(socket, 1);
  server.reported = (socket) => socket.send(JSON.stringify({ type: "error", code: "invalid_input", message: "twice" }));
  await assert.rejects(simulate(), (error) => error instanceof InvalidInput && error.message === "twice");
});

test("it can be aborted", async () => {
  const controller = new AbortController();
  server.opened = () => controller.abort(new Error("enough"));
  await assert.rejects(simulate({ signal: controller.signal }), /enough/);
});
