import assert from "node:assert/strict";
import { afterEach, test } from "node:test";
import {
  Client,
  Conflict,
  DeadlineExceeded,
  Forbidden,
  InvalidInput,
  LeagueError,
  NotFound,
  NotReady,
  Overloaded,
  RemoteError,
  Unauthenticated,
  VersionRetired,
} from "policy-league-client";
import { ConnectionLost, Reply, Retries } from "../src/retries.js";
import { ACTED, type Answer, DROP, failure, NO_RESPONSE, PreparedServer } from "./prepared_server.js";

const MOVED = { league: "board", alias: "champion", kind: "promotion", version: 2, previous: 1, event: 3 };
const servers: PreparedServer[] = [];

async function prepared(...answers: Answer[]): Promise<PreparedServer> {
  const server = await PreparedServer.start(...answers);
  servers.push(server);
  return server;
}

afterEach(async () => {
  for (const server of servers.splice(0)) await server.stop();
});

test("a promotion is retried with the same Idempotency-Key", async () => {
  const moved = { status: 200, body: MOVED };
  const server = await prepared({ status: DROP }, failure(502, "replica_lost"), { status: NO_RESPONSE }, moved);
  const client = new Client(server.url, { key: "plk_x", timeout: 1500 });
  assert.equal((await client.promote("board@2", { expected: 1, reason: "better" })).event, 3);
  assert.equal(server.requests.length, 4);
  assert.deepEqual([...new Set(server.requests.map(({ body }) => body))], [
    '{"version":2,"expected":1,"reason":"better"}',
  ]);
  const headers = server.requests.map((request) => request.headers);
  assert.equal(new Set(headers.map((sent) => sent["idempotency-key"])).size, 1);
  assert.deepEqual([...new Set(headers.map((sent) => sent.authorization))], ["Bearer plk_x"]);
  assert.deepEqual([...new Set(headers.map((sent) => sent["x-request-timeout-ms"]))], ["1500"]);
  await client.promote("board@2:0.75,@3:0.25", { idempotencyKey: "mine", expected: null });
  const last = server.requests.at(-1);
  assert.equal(last?.headers["idempotency-key"], "mine");
  const members = [{ version: 2, probability: 0.75 }, { version: 3, probability: 0.25 }];
  assert.deepEqual(JSON.parse(last?.body ?? ""), { members, expected: null });
  await client.rollback("board");
  assert.equal(new Set(server.requests.map((request) => request.headers["idempotency-key"])).size, 3);
});

test("a retry repeats the seed", async () => {
  const busy = failure(429, "overloaded", { "retry-after": "0" });
  const server = await prepared({ status: DROP }, busy, failure(504, "deadline_exceeded"), { status: 200, body: ACTED });
  const answer = await new Client(server.url).act("board", [1], { explore: true });
  assert.equal(server.requests.length, 4);
  assert.deepEqual([...new Set(server.requests.map(({ body }) => JSON.parse(body).seed))], [answer.seed]);
});

test("a search version explains its action", async () => {
  const analysis = { value: 0.5, visits: [3, 5], line: [1, 0] };
  const server = await prepared({ status: 200, body: { ...ACTED, simulations: 8, analysis } });
  const answer = await new Client(server.url).act("board@2", [1], { explore: false, deadlineMs: 20, analysis: true });
  assert.deepEqual(JSON.parse(server.requests[0]?.body ?? ""), {
    observation: [1],
    explore: false,
    deadline_ms: 20,
    analysis: true,
  });
  assert.equal(answer.simulations, 8);
  assert.deepEqual(answer.analysis, analysis);
});

const STATUSES: [Answer, new (...details: never[]) => LeagueError, boolean][] = [
  [failure(400, "invalid_observation"), InvalidInput, false],
  [failure(401, "unauthenticated"), Unauthenticated, false],
  [failure(403, "forbidden"), Forbidden, false],
  [failure(404, "unknown_league"), NotFound, false],
  [failure(409, "alias_moved"), Conflict, false],
  [failure(410, "version_retired"), VersionRetired, false],
  [failure(413, "body_too_large"), InvalidInput, false],
  [failure(429, "rate_limited", { "retry-after": "0" }), Overloaded, true],
  [failure(500, "internal_error"), RemoteError, false],
  [failure(502, "replica_lost"), RemoteError, true],
  [failure(503, "not_ready"), NotReady, true],
  [failure(503, "no_replica"), NotReady, true],
  [failure(504, "deadline_exceeded"), DeadlineExceeded, true],
  [{ status: 500, body: "<html>" }, RemoteError, true],
  [{ status: 404, body: "<html>" }, RemoteError, true],
  [{ status: 403, body: "<html>" }, RemoteError, false],
  [{ status: 200, body: "<html>" }, RemoteError, false],
  [{ status: DROP }, RemoteError, true],
];

for (const [answer, kind, isRetried] of STATUSES) {
  const { code } = (answer.body ?? {}) as { code?: string };
  const name = `${answer.status} ${code ?? answer.body ?? "a lost connection"}`;
  test(`${name} is ${isRetried ? "" : "not "}retried`, () => {
    const text = typeof answer.body === "string" ? answer.body : JSON.stringify(answer.body ?? "");
    const outcome = answer.status === DROP ? new ConnectionLost("lost") : new Reply(answer.status, text);
    assert.equal(new Retries(10_000).nextDelay(outcome) !== undefined, isRetried);
    assert.equal(new Retries(0).nextDelay(outcome), undefined);
  });
  test(`${name} is an error of its own class`, async () => {
    const server = await prepared(answer);
    await assert.rejects(new Client(server.url, { retryDeadline: 0 }).act("board", [1]), (error) => {
      assert.ok(error instanceof kind);
      assert.equal(error.constructor, kind);
      assert.equal(error.status, answer.status || undefined);
      assert.equal(error.code, code ?? "remote_error");
      return true;
    });
    assert.equal(server.requests.length, 1);
  });
}

test("Retry-After is a lower bound, and ends the retries beyond the deadline", async () => {
  const busy = failure(429, "rate_limited", { "retry-after": "1" });
  const server = await prepared(busy, { status: 200, body: ACTED });
  const start = performance.now();
  await new Client(server.url).act("board", [1]);
  assert.ok(performance.now() - start >= 1000);
  server.answers = [failure(429, "rate_limited", { "retry-after": "60" })];
  await assert.rejects(new Client(server.url, { retryDeadline: 30_000 }).act("board", [1]), (error) => {
    assert.ok(error instanceof Overloaded);
    assert.equal(error.retryAfter, 60_000);
    return true;
  });
  assert.equal(server.requests.length, 3);
});

test("the timeout applies to each attempt", async () => {
  const silent = { status: NO_RESPONSE };
  const server = await prepared(silent, silent, { status: 200, body: ACTED });
  assert.equal((await new Client(server.url, { timeout: 1500 }).act("board", [1])).action, 4);
  assert.equal(server.requests.length, 3);
});

test("a signal ends a call and its retries", async () => {
  const server = await prepared({ status: NO_RESPONSE });
  const abort = new AbortController();
  const acted = new Client(server.url).act("board", [1], { signal: abort.signal });
  while (!server.requests.length) await new Promise((resolve) => setTimeout(resolve, 5));
  abort.abort(new Error("the game is over"));
  await assert.rejects(acted, /the game is over/);
  server.answers = [failure(504, "deadline_exceeded")];
  const between = new AbortController();
  const retried = new Client(server.url, { retryDeadline: 60_000 }).act("board", [1], { signal: between.signal });
  while (server.requests.length < 4) await new Promise((resolve) => setTimeout(resolve, 5));
  between.abort(new Error("the game is over"));
  await assert.rejects(retried, /the game is over/);
});

test("an episode stays with the version of its first action, and returns its state", async () => {
  const server = await prepared({ status: 200, body: { ...ACTED, version: 7, state: "AQ" } });
  const episode = new Client(server.url).episode<number>("board.left@champion", { explore: true, seed: 7 });
  for (let step = 0; step < 3; step++) assert.equal(await episode.act([1]), 4);
  assert.deepEqual([episode.version, episode.steps, episode.last?.state], [7, 3, "AQ"]);
  const paths = ["champion", "7", "7"].map((version) => `/v1/policies/board.left/action?version=${version}`);
  assert.deepEqual(server.requests.map(({ path }) => path), paths);
  assert.deepEqual(server.requests.map(({ body }) => JSON.parse(body).state), [undefined, "AQ", "AQ"]);
  assert.equal(new Set(server.requests.map(({ body }) => /"seed":(\d+)/.exec(body)?.[1])).size, 3);
  server.answers = [failure(404, "unknown_version")];
  await assert.rejects(episode.act([1]), VersionRetired);
});

test("a promotion waits until every replica serves it", async () => {
  const server = await prepared({ status: 200, body: MOVED });
  const replicas = (event: number) => [{ replica: "a", aliases: { champion: 2 }, event, fault: null }];
  const league = (event: number) => ({ status: 200, body: { league: "board", aliases: { champion: 2 }, replicas: replicas(event) } });
  server.answers = [{ status: 200, body: MOVED }, league(2), league(2), league(3)];
  await new Client(server.url).promote("board@2", { wait: 5000 });
  assert.equal(server.requests.length, 4);
  server.answers = [{ status: 200, body: MOVED }, { status: 200, body: { league: "board", aliases: { champion: 5 }, replicas: [] } }];
  await assert.rejects(new Client(server.url).promote("board@2", { wait: 5000 }), Conflict);
});

test("invalid arguments are named", async () => {
  const client = new Client("http://127.0.0.1:9");
  for (const url of ["board", "ftp://a", ""]) assert.throws(() => new Client(url), InvalidInput);
  assert.throws(() => new Client(undefined, { key: "plk_\n ö" }), /API key/);
  assert.throws(() => new Client(undefined, { timeout: 0 }), /timeout is 0 ms/);
  for (const model of ["", "Board", "a.b.c", "a@b@c"]) await assert.rejects(client.act(model, 1), /model/);
  for (const ref of ["board", "board@champion", "board@2:0.5,other@3:0.5"]) {
    await assert.rejects(client.promote(ref), InvalidInput);
  }
});
