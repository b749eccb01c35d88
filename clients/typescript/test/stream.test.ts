import assert from "node:assert/strict";
import { once } from "node:events";
import { createServer, type Server } from "node:http";
import type { AddressInfo } from "node:net";
import { afterEach, beforeEach, test } from "node:test";
import { Client, InvalidInput, NotFound, RemoteError, Unauthenticated, VersionRetired } from "policy-league-client";
import { WebSocket, WebSocketServer } from "ws";

type Body = Record<string, unknown>;

/** A server whose streams answer with the number of the message and a state of it, in the format of the message. */
class StreamServer {
  readonly messages: Body[] = [];
  readonly openings: { url: string; protocols: string | undefined }[] = [];
  /** Handles the next message in place of an answer. */
  next: ((socket: WebSocket) => void) | undefined;
  /** The answer to requests without a stream: an action or an error. */
  action = { status: 200, body: { action: 0, version: 3 } as Body };
  /** The number of streams to refuse. */
  refusals = 0;
  readonly #http: Server;
  readonly #sockets: WebSocketServer;

  constructor() {
    this.#sockets = new WebSocketServer({ noServer: true, handleProtocols: () => "policy-league" });
    this.#http = createServer((_, response) => {
      response.writeHead(this.action.status).end(JSON.stringify(this.action.body));
    });
    this.#http.on("upgrade", (request, socket, head) => {
      this.openings.push({ url: request.url ?? "", protocols: request.headers["sec-websocket-protocol"] });
      if (this.refusals-- > 0) return socket.end("HTTP/1.1 404 Not Found\r\ncontent-length: 0\r\n\r\n");
      this.#sockets.handleUpgrade(request, socket, head, (stream) => this.#serve(stream));
    });
  }

  async start(): Promise<void> {
    this.#http.listen(0, "127.0.0.1");
    await once(this.#http, "listening");
  }

  get url(): string {
    return `http://127.0.0.1:${(this.#http.address() as AddressInfo).port}`;
  }

  /** Ends all connections without a closing handshake, as when the process dies. */
  drop(): void {
    for (const stream of this.#sockets.clients) stream.terminate();
  }

  async stop(): Promise<void> {
    this.drop();
    this.#http.closeAllConnections();
    await new Promise((resolve) => this.#http.close(resolve));
  }

  #serve(stream: WebSocket): void {
    stream.on("message", (text, isBinary) => {
      const message: Body = isBinary ? {} : JSON.parse(String(text));
      this.messages.push(message);
      const { next } = this;
      this.next = undefined;
      if (next) next(stream);
      else if (isBinary) stream.send(Uint8Array.of(1, 0, 0, 0, 1, 0, 0, 0, 3, 0, 0, 0, 0, 0, 0, 0, this.messages.length));
      else stream.send(JSON.stringify(answer(message, this.messages.length)));
    });
  }
}

function answer(message: Body, number: number): Body {
  const rows = message["observations"] as unknown[] | undefined;
  const state = rows ? rows.map((_, row) => `s${number}${row}`) : `s${number}`;
  const actions = rows ? { actions: rows.map(() => number) } : { action: number };
  return { ...actions, version: 3, sha256: "0", ...(message["return_state"] === true && { state }) };
}

let server: StreamServer;
let client: Client;

beforeEach(async () => {
  server = new StreamServer();
  await server.start();
  client = new Client(server.url, { key: "plk_x" });
});

afterEach(() => server.stop());

for (const kind of [undefined, WebSocket]) {
  test(`a stream continues after a lost connection (${kind ? "ws" : "the global WebSocket"})`, async () => {
    client = new Client(server.url, { key: "plk_x", ...(kind && { WebSocket: kind }) });
    const stream = client.stream<number>("board@champion");
    assert.equal(await stream.act(5, { reset: true }), 1);
    assert.equal(await stream.act(6), 2);
    server.next = (socket) => socket.terminate();
    assert.equal(await stream.act(7, { explore: true }), 4);
    server.drop();
    assert.deepEqual(await stream.actBatch([8, 9], { reset: true }), [5, 5]);
    server.next = (socket) => {
      socket.send('{"closing": true, "state": "x"}');
      socket.close(1012, "draining");
    };
    assert.deepEqual(await stream.actBatch([8, 9], { reset: [false, true] }), [7, 7]);
    stream.close();
    const urls = server.openings.map(({ url }) => url.replace("/v1/policies/board/stream?version=", ""));
    assert.deepEqual(urls, ["champion", "3", "3", "3"]);
    assert.deepEqual([...new Set(server.openings.map(({ protocols }) => protocols?.replaceAll(" ", "")))], [
      "policy-league,policy-league.key.plk_x",
    ]);
    const states = server.messages.map(({ state, reset }) => [state, reset]);
    assert.deepEqual(states, [
      [undefined, true],
      [undefined, undefined],
      [undefined, undefined],
      ["s2", undefined],
      [undefined, true],
      [undefined, [false, true]],
      [["s50", null], undefined],
    ]);
    assert.equal(server.messages[2]?.["seed"], server.messages[3]?.["seed"], "a retry has the same seed");
    assert.deepEqual([stream.version, stream.last?.state], [3, ["s70", "s71"]]);
  });
}

test("a stream that follows an alias keeps the version of its episode when it reconnects", async () => {
  const stream = client.stream("board@candidate", { follow: true });
  await stream.act(1);
  server.drop();
  await stream.act(1);
  stream.close();
  assert.deepEqual(server.openings.map(({ url }) => url.split("?")[1]), [
    "follow=candidate",
    "follow=candidate&version=3",
  ]);
});

test("an error does not end a stream, and busy servers are asked again", async () => {
  const stream = client.stream<number>("board");
  server.next = (socket) => socket.send('{"code": "invalid_observation", "message": "no", "status": 400}');
  await assert.rejects(stream.act(1), InvalidInput);
  server.next = (socket) => socket.send('{"code": "rate_limited", "message": "no", "status": 429, "retry_after": 1}');
  const start = performance.now();
  assert.equal(await stream.act(1), 3);
  assert.ok(performance.now() - start >= 1000);
  server.next = (socket) => socket.send("<html>");
  await assert.rejects(stream.act(1), RemoteError);
  stream.close();
  assert.equal(server.openings.length, 1);
});

test("a stream that is refused throws what a request for the action would", async () => {
  server.refusals = Infinity;
  server.action = { status: 404, body: { code: "unknown_league", message: "no" } };
  await assert.rejects(client.stream("board").act(1), NotFound);
  await assert.rejects(client.stream("board").actBinary([new Int8Array(3)]), NotFound);
  assert.equal(server.openings.length, 2);
  server.action = { status: 200, body: { action: 0, version: 3 } };
  const impatient = new Client(server.url, { retryDeadline: 0 });
  await assert.rejects(impatient.stream("board").act(1), RemoteError);
  server.action = { status: 400, body: { code: "invalid_observation", message: "null" } };
  await assert.rejects(impatient.stream("board").actBinary([new Int8Array(3)]), RemoteError);
  server.action = { status: 200, body: { action: 0, version: 3 } };
  server.refusals = 2;
  assert.equal(await client.stream<number>("board").act(1), 1);
  assert.equal(server.openings.length, 7);
});

test("a stream whose version is gone after a reconnection throws VersionRetired", async () => {
  const stream = client.stream("board");
  await stream.act(1);
  server.drop();
  server.refusals = Infinity;
  server.action = { status: 404, body: { code: "unknown_version", message: "no" } };
  await assert.rejects(stream.act(1), VersionRetired);
});

test("close codes that would come again are final", async () => {
  for (const [code, kind] of [[1008, Unauthenticated], [1009, InvalidInput], [1007, RemoteError]] as const) {
    const stream = client.stream("board");
    server.next = (socket) => socket.close(code, "for a reason");
    await assert.rejects(stream.act(1), (error) => error instanceof kind && /for a reason/.test(error.message));
  }
  assert.equal(server.messages.length, 3);
});

test("binary and text messages share a stream", async () => {
  const stream = client.stream<number>("board");
  const actions = async () => [...new Uint8Array((await stream.actBinary([new Int8Array(3)])).actions)];
  assert.deepEqual(await actions(), [1]);
  assert.equal(stream.version, 3);
  assert.equal(await stream.act(1), 2);
  server.next = (socket) => socket.send('{"code": "invalid_observation", "message": "no", "status": 400}');
  await assert.rejects(actions(), InvalidInput);
  server.drop();
  assert.deepEqual(await actions(), [4]);
  server.next = (socket) => socket.send('{"action": 1}');
  await assert.rejects(actions(), RemoteError);
  stream.close();
});

test("a late answer is not taken for the next one", async () => {
  const stream = new Client(server.url, { timeout: 1500 }).stream<number>("board");
  let late: WebSocket | undefined;
  server.next = (socket) => {
    late = socket;
  };
  assert.equal(await stream.act(1), 2);
  late?.send(JSON.stringify(answer({}, 1)));
  assert.equal(await stream.act(1), 3);
  const abort = new AbortController();
  server.next = () => abort.abort(new Error("the game is over"));
  await assert.rejects(stream.act(1, { signal: abort.signal }), /the game is over/);
  assert.equal(await stream.act(1), 5);
  stream.close();
});

test("one action at a time", async () => {
  const stream = client.stream<number>("board");
  const first = stream.act(1);
  await assert.rejects(stream.act(2), /pending/);
  assert.equal(await first, 1);
  stream.close();
});
