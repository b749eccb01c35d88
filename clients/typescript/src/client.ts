/** HTTP client for a policy server: actions, episodes, streams, versions, promotions and evaluations. */

import { Episode, type EpisodeOptions } from "./episode.js";
import { Conflict, InvalidInput, NotReady } from "./errors.js";
import type { components } from "./openapi.js";
import { checkName, leaguePath, Model, parseMembers } from "./references.js";
import { encode, type Observation, optionFields, type ResponseOptions, type Seed, toJson, usedSeed } from "./requests.js";
import { type Action, type ActionResponse, type BatchActionResponse, parseAction, parseActions } from "./responses.js";
import { checked, ConnectionLost, type Outcome, Reply, Retries, sleep } from "./retries.js";
import { simulate, type SimulatedGame, type SimulatorOptions } from "./simulator.js";
import { Stream } from "./stream.js";
import { webSocketClass, type WebSocketConstructor } from "./web_socket.js";

type Schemas = components["schemas"];

/** Milliseconds between two requests that poll a state. */
const POLL_INTERVAL = 50;

/** Options of a client. */
export interface ClientOptions {
  /** API key. Defaults to the environment variable `LEAGUE_API_KEY`, where there are such. */
  key?: string;
  /**
   * Identifies a player or an episode. During a canary release, requests of one caller are always answered by the same
   * version, and of a mixture by the same member. Streams do not send it.
   */
  caller?: string;
  /** Milliseconds for one attempt; default 5000. The server stops working on a request after the same time. */
  timeout?: number;
  /**
   * Milliseconds after the first attempt within which a failed request is retried if the server was unreachable or
   * busy; default 10000; 0 disables retries. Every request is safe to repeat.
   */
  retryDeadline?: number;
  /** The class for streams; by default the global `WebSocket` of browsers and of Node.js 22. */
  WebSocket?: WebSocketConstructor;
}

/** Options of every call. */
export interface CallOptions {
  /** Ends the call: it rejects with the reason of the signal. */
  signal?: AbortSignal;
}

/** Options of a request for actions. */
export interface ActOptions extends CallOptions, ResponseOptions {
  /** Seed for sampling. By default a random one, which the response contains. */
  seed?: Seed;
  /** Recurrent state of the previous response; without it an episode starts. `Client.episode` tracks it for you. */
  state?: string;
}

/** Options of a request for the actions of a batch. */
export interface ActBatchOptions extends Omit<ActOptions, "seed" | "state"> {
  /** One seed for the batch, or one for each observation. */
  seed?: Seed | readonly Seed[];
  /** Recurrent state of each observation; null starts an episode. */
  state?: readonly (string | null)[];
}

/** Options of a change. */
export interface ChangeOptions extends CallOptions {
  /** Text for the audit log. */
  reason?: string;
  /** A request with the same key is applied once. By default a random key. */
  idempotencyKey?: string;
  /** Milliseconds to wait for the effect; default 0. Waiting also requires the scope `read`. */
  wait?: number;
}

/** An HTTP request that is safe to repeat. */
interface Call {
  method?: "GET" | "POST" | "DELETE";
  path: string;
  body?: string;
  headers?: Record<string, string>;
}

/**
 * Client for a policy server.
 *
 * A model is `connect_four`, `connect_four@3`, `connect_four@champion`, or `simple_adversary.good@3` if a version has
 * several policies. The type parameter `A` of methods that return actions states the type of the policy's actions; it is
 * not checked. Every method throws the `LeagueError` of the server's response, `InvalidInput` for arguments that cannot
 * be sent, and `RemoteError` if the server is unreachable.
 */
export class Client {
  /** Base URL of the server. */
  readonly url: string;
  /** Milliseconds for one attempt. */
  readonly timeout: number;
  /** Milliseconds within which a failed request is retried. */
  readonly retryDeadline: number;
  /** API key; undefined if none is sent. */
  readonly key: string | undefined;
  readonly #headers: Record<string, string>;
  readonly #webSocket: WebSocketConstructor | undefined;

  constructor(url = "http://127.0.0.1:8000", options: ClientOptions = {}) {
    const { key = environmentKey(), caller, timeout = 5000, retryDeadline = 10_000 } = options;
    if (!(timeout > 0)) throw new InvalidInput(`timeout is ${timeout} ms, expected more than 0`);
    if (!URL.canParse(url) || !/^https?:$/.test(new URL(url).protocol)) {
      throw new InvalidInput(`"${url}" is not the address of a server: expected a URL such as http://127.0.0.1:8000`);
    }
    this.url = url.replace(/\/+$/, "");
    this.timeout = timeout;
    this.retryDeadline = retryDeadline;
    this.key = key ? checkHeader("API key", key) : undefined;
    this.#webSocket = options.WebSocket;
    this.#headers = {
      "x-request-timeout-ms": String(Math.max(1, Math.round(timeout))),
      ...(this.key && { authorization: `Bearer ${this.key}` }),
      ...(caller !== undefined && { "x-league-key": checkHeader("caller", caller) }),
    };
  }

  /** Requests the action for one observation. */
  async act<A extends Action = Action>(
    model: string,
    observation: Observation,
    { seed, state, signal, ...options }: ActOptions = {},
  ): Promise<ActionResponse<A>> {
    const used = usedSeed(options.explore, seed);
    const body = { observation: encode(observation), ...optionFields(options), state };
    return parseAction<A>(await this.#act(Model.parse(model), toJson({ ...body, seed: used }), signal), used);
  }

  /** Requests the actions for a batch of observations; one version answers all of them. */
  async actBatch<A extends Action = Action>(
    model: string,
    observations: readonly Observation[],
    { seed, state, signal, ...options }: ActBatchOptions = {},
  ): Promise<BatchActionResponse<A>> {
    const used = usedSeed(options.explore, seed);
    const body = { observations: observations.map(encode), ...optionFields(options), state };
    return parseActions<A>(await this.#act(Model.parse(model), toJson({ ...body, seed: used }), signal), used);
  }

  /** Starts an episode, whose actions all come from one version. */
  episode<A extends Action = Action>(model: string, options: EpisodeOptions = {}): Episode<A> {
    return new Episode<A>(this, Model.parse(model), options);
  }

  /**
   * Creates a WebSocket stream for a program that needs an action at every tick. It connects at the first action.
   *
   * `follow`: each action comes from the version that the alias of `model` (default: `champion`) names at that moment.
   * Otherwise the version with which the stream opened answers every message.
   */
  stream<A extends Action = Action>(model: string, { follow = false }: { follow?: boolean } = {}): Stream<A> {
    return new Stream<A>(this, Model.parse(model), follow, this.#webSocket);
  }

  /**
   * Plays episodes of a game that runs in this program, for training runs and evaluations of a league. Requires the scope
   * `simulate`.
   *
   * It connects again whenever the connection is lost, and while nothing needs episodes. Rejects with a LeagueError if the
   * server refuses the simulator or a report. `makeGame`: creates a game, which plays one episode after the other.
   */
  simulate<A extends Action = Action>(
    league: string,
    makeGame: () => SimulatedGame<A>,
    options: SimulatorOptions,
  ): Promise<void> {
    return simulate(this, league, makeGame, webSocketClass(this.#webSocket), options);
  }

  /** Returns what needs episodes of a league's simulators. Requires the scope `simulate`. */
  async simulations(league: string, options: CallOptions = {}): Promise<readonly Schemas["Simulation"][]> {
    return (await this.#get<Schemas["Simulations"]>(`${leaguePath(league)}/simulations`, options)).simulations;
  }

  /** Returns all leagues with their aliases. */
  async leagues(options: CallOptions = {}): Promise<Schemas["ListedLeague"][]> {
    return (await this.#get<Schemas["Leagues"]>("/v1/leagues", options)).leagues;
  }

  /** Returns the aliases of a league, its policies with their spaces, and the versions that each replica serves. */
  league(league: string, options: CallOptions = {}): Promise<Schemas["League"]> {
    return this.#get<Schemas["League"]>(leaguePath(league), options);
  }

  /** Returns the versions of a league in ascending order. */
  async versions(league: string, options: CallOptions = {}): Promise<Schemas["ListedVersion"][]> {
    return (await this.#get<Schemas["Versions"]>(`${leaguePath(league)}/versions`, options)).versions;
  }

  /** Returns the version number of each alias of a league. */
  async aliases(league: string, options: CallOptions = {}): Promise<Record<string, number>> {
    return (await this.league(league, options)).aliases;
  }

  /**
   * Points an alias at a version, `connect_four@3`, or at a mixture, `connect_four@3:0.6,@5:0.4`. Requires the scope
   * `promote`.
   *
   * `expected`: the version that the alias must point to beforehand, null if it must not exist; by default the alias is
   * moved unconditionally. With `wait` it returns when every replica serves the version, or throws NotReady.
   */
  async promote(
    ref: string,
    { alias = "champion", expected, ...options }: ChangeOptions & { alias?: string; expected?: number | null } = {},
  ): Promise<Schemas["AliasChange"]> {
    const { league, members } = parseMembers(ref);
    const target = ref.includes(":") ? { members } : { version: members[0]?.version };
    const path = `${leaguePath(league)}/aliases/${checkName("alias", alias)}`;
    return this.#moveAlias(path, { ...target, expected }, options);
  }

  /** Restores the previous champion, if it is `expected` now. See `promote`. */
  rollback(
    league: string,
    { expected, ...options }: ChangeOptions & { expected?: number } = {},
  ): Promise<Schemas["AliasChange"]> {
    return this.#moveAlias(`${leaguePath(league)}/rollback`, { expected }, options);
  }

  /** Starts an evaluation. Requires the scope `evaluate`. With `wait` it returns when the evaluation has ended. */
  async evaluate(
    league: string,
    request: Schemas["EvaluationRequest"] = {},
    options: Omit<ChangeOptions, "reason"> = {},
  ): Promise<Schemas["Evaluation"]> {
    const deadline = performance.now() + (options.wait ?? 0);
    let status = await this.#change<Schemas["Evaluation"]>(`${leaguePath(league)}/evaluations`, request, options);
    while (["queued", "running"].includes(status.state) && performance.now() < deadline) {
      await sleep(POLL_INTERVAL, options.signal);
      status = await this.evaluation(league, status.evaluation, options);
    }
    return status;
  }

  /** Returns the progress of an evaluation, with its result if it is `done`. */
  evaluation(league: string, number: number, options: CallOptions = {}): Promise<Schemas["Evaluation"]> {
    return this.#get<Schemas["Evaluation"]>(`${leaguePath(league)}/evaluations/${number}`, options);
  }

  /** Returns evaluations of a league without results, newest first, those with a smaller number than `before`. */
  async evaluations(
    league: string,
    { before, limit = 20, ...options }: CallOptions & { before?: number; limit?: number } = {},
  ): Promise<Schemas["EvaluationSummary"][]> {
    const query = `limit=${limit}${before === undefined ? "" : `&before=${before}`}`;
    return (await this.#get<Schemas["Evaluations"]>(`${leaguePath(league)}/evaluations?${query}`, options)).evaluations;
  }

  /** Requests the end of an evaluation, which takes a few seconds. An ended evaluation is not changed. */
  stopEvaluation(league: string, number: number, options: CallOptions = {}): Promise<Schemas["Evaluation"]> {
    const call: Call = { method: "DELETE", path: `${leaguePath(league)}/evaluations/${number}` };
    return this.#json<Schemas["Evaluation"]>(call, options.signal);
  }

  /** Returns whether a replica responds. Sends one request, without retries. */
  isLive(options: CallOptions = {}): Promise<boolean> {
    return this.#isHealthy("live", options);
  }

  /** Returns whether a replica has loaded the versions of all aliases. Sends one request, without retries. */
  isReady(options: CallOptions = {}): Promise<boolean> {
    return this.#isHealthy("ready", options);
  }

  /** Waits until a replica is ready. Throws NotReady if none is within `timeout` milliseconds, by default a minute. */
  async waitUntilReady({ timeout = 60_000, signal }: CallOptions & { timeout?: number } = {}): Promise<void> {
    const deadline = performance.now() + timeout;
    while (!(await this.isReady({ ...(signal && { signal }) }))) {
      if (performance.now() > deadline) throw new NotReady(`${this.url} was not ready within ${timeout} ms`);
      await sleep(POLL_INTERVAL, signal);
    }
  }

  /** @internal Sends one request for actions, and returns what became of it. */
  tryAct(model: Model, body: string, signal: AbortSignal | undefined): Promise<Outcome> {
    return this.#attempt({ path: `${model.path}/action${model.query}`, body }, signal);
  }

  #act(model: Model, body: string, signal: AbortSignal | undefined): Promise<Reply> {
    return this.#send({ path: `${model.path}/action${model.query}`, body }, signal);
  }

  #get<T>(path: string, { signal }: CallOptions): Promise<T> {
    return this.#json<T>({ path }, signal);
  }

  #change<T>(path: string, body: object, { reason, idempotencyKey, signal }: ChangeOptions): Promise<T> {
    const headers = { "idempotency-key": idempotencyKey ?? uniqueKey() };
    const text = JSON.stringify({ ...body, ...(reason !== undefined && { reason }) });
    return this.#json<T>({ path, body: text, headers }, signal);
  }

  async #json<T>(call: Call, signal: AbortSignal | undefined): Promise<T> {
    return (await this.#send(call, signal)).body as T;
  }

  /** Sends a call, retries it after temporary failures, and returns the response of the server. */
  async #send(call: Call, signal: AbortSignal | undefined): Promise<Reply> {
    const retries = new Retries(this.retryDeadline);
    for (;;) {
      const outcome = await this.#attempt(call, signal);
      const delay = retries.nextDelay(outcome);
      if (delay === undefined) return checked(outcome, this.url + call.path);
      await sleep(delay, signal);
    }
  }

  async #attempt({ method, path, body, headers }: Call, signal: AbortSignal | undefined): Promise<Outcome> {
    const limit = AbortSignal.timeout(this.timeout);
    try {
      const response = await fetch(this.url + path, {
        method: method ?? (body === undefined ? "GET" : "POST"),
        headers: { ...this.#headers, ...(body !== undefined && { "content-type": "application/json" }), ...headers },
        signal: signal ? AbortSignal.any([signal, limit]) : limit,
        ...(body !== undefined && { body }),
      });
      const replica = response.headers.get("x-league-replica") ?? undefined;
      return new Reply(response.status, await response.text(), response.headers.get("retry-after"), replica);
    } catch (error) {
      signal?.throwIfAborted();
      const { cause } = error as { cause?: unknown }; // Node.js: why the connection failed
      return new ConnectionLost(String((cause instanceof Error && cause.message) || error), { cause: error });
    }
  }

  async #isHealthy(probe: string, { signal }: CallOptions): Promise<boolean> {
    const outcome = await this.#attempt({ path: `/v1/health/${probe}` }, signal);
    return outcome instanceof Reply && outcome.status === 200;
  }

  async #moveAlias(path: string, body: object, options: ChangeOptions): Promise<Schemas["AliasChange"]> {
    const change = await this.#change<Schemas["AliasChange"]>(path, body, options);
    const { wait = 0, signal } = options;
    const deadline = performance.now() + wait;
    while (wait) {
      const outdated = outdatedReplicas(await this.league(change.league, { ...(signal && { signal }) }), change);
      if (!outdated.length) break;
      if (performance.now() > deadline) {
        const alias = `${change.league}@${change.alias} is version ${change.version}`;
        throw new NotReady(`${alias}, but not every replica serves it after ${wait} ms: ${outdated.join("; ")}`);
      }
      await sleep(POLL_INTERVAL, signal);
    }
    return change;
  }
}

/** Describes each replica that does not serve a promoted version yet. Throws Conflict if the alias was moved since. */
function outdatedReplicas(league: Schemas["League"], { alias, version, event }: Schemas["AliasChange"]): string[] {
  const current = league.aliases[alias];
  if (current !== version) {
    const message = `${league.league}@${alias} has been moved to version ${current} meanwhile`;
    throw new Conflict(message, { code: "alias_moved" });
  }
  if (!league.replicas.length) return ["no replica has reported the versions that it serves"];
  return league.replicas
    .filter((replica) => replica.aliases[alias] !== version || (replica.event ?? 0) < event)
    .map((replica) => `${replica.replica} served ${replica.aliases[alias]} (${replica.fault ?? "no error"})`);
}

function environmentKey(): string | undefined {
  const { process } = globalThis as { process?: { env?: Record<string, string | undefined> } };
  return process?.env?.["LEAGUE_API_KEY"];
}

function checkHeader(name: string, text: string): string {
  const trimmed = text.trim();
  if (!/^[\x20-\x7e]*$/.test(trimmed)) {
    throw new InvalidInput(`the ${name} contains invalid characters: expected printable ASCII`);
  }
  return trimmed;
}

/** A random key. `crypto.randomUUID` exists in secure contexts only. */
function uniqueKey(): string {
  return Array.from(crypto.getRandomValues(new Uint32Array(4)), (word) => word.toString(16).padStart(8, "0")).join("");
}

