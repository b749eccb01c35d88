/** WebSocket streams for programs that need an action at every tick: one message in each direction per action. */

import { type BinaryRequestOptions, type BinaryResponse, decodeResponse, encodeRequest } from "./binary.js";
import type { ActBatchOptions, ActOptions, CallOptions, Client } from "./client.js";
import { InvalidInput, interrupted, LeagueError, RemoteError } from "./errors.js";
import { Model } from "./references.js";
import { type ActionBody, encode, type NumericArray, type Observation, optionFields, toJson, usedSeed } from "./requests.js";
import { type Action, type ActionResponse, type BatchActionResponse, parseAction, parseActions } from "./responses.js";
import { checked, ConnectionLost, type Outcome, Reply, Retries, sleep } from "./retries.js";
import { Connection, Refused, webSocketClass, type WebSocketConstructor } from "./web_socket.js";

/** Options of an action of a stream. */
export interface StreamActOptions extends Omit<ActOptions, "state"> {
  /** Start an episode with this observation: the recurrent state is reset. */
  reset?: boolean;
}

/** Options of the actions of a batch of a stream. */
export interface StreamActBatchOptions extends Omit<ActBatchOptions, "state"> {
  /** Start an episode in every row, or in the rows that are true. */
  reset?: boolean | readonly boolean[];
}

/**
 * A WebSocket stream, created by `Client.stream`.
 *
 * It connects at the first action and reconnects whenever the connection is lost, for example because its replica shuts
 * down. Its version and its recurrent state survive: the server returns the state with each response, and after a
 * reconnection the episode continues from the last one, because messages without a response were not applied. Wait for
 * each action before you request the next one.
 */
export class Stream<A extends Action = Action> {
  readonly #client: Client;
  readonly #follow: boolean;
  readonly #webSocket: WebSocketConstructor;
  #model: Model;
  #connection: Connection | undefined;
  #state: string | string[] | undefined;
  #hasState = true;
  #isNew = true;
  #isActing = false;
  #last: ActionResponse<A> | BatchActionResponse<A> | undefined;

  /** @internal */
  constructor(client: Client, model: Model, follow: boolean, webSocket: WebSocketConstructor | undefined) {
    this.#client = client;
    this.#model = model;
    this.#follow = follow;
    this.#webSocket = webSocketClass(webSocket);
  }

  /** The version that answers; undefined before the first action if the model has no version number. */
  get version(): number | undefined {
    const { version } = this.#model;
    return typeof version === "number" ? version : this.#last?.version;
  }

  /** The last response; undefined before the first action. */
  get last(): ActionResponse<A> | BatchActionResponse<A> | undefined {
    return this.#last;
  }

  /**
   * Requests the action for one observation.
   *
   * Throws VersionRetired if the stream had to reconnect, and its version is not served any more.
   */
  async act(observation: Observation, options: StreamActOptions = {}): Promise<A> {
    const { reset = false, signal } = options;
    const seed = usedSeed(options.explore, options.seed);
    const body = { observation: encode(observation), ...optionFields(options), seed };
    const response = parseAction<A>(await this.#ask(body, reset, signal), seed);
    this.#last = response;
    return response.action;
  }

  /** Requests the actions for a batch of observations. See `act`. */
  async actBatch(observations: readonly Observation[], options: StreamActBatchOptions = {}): Promise<A[]> {
    const { reset = false, signal } = options;
    const seed = usedSeed(options.explore, options.seed);
    const body = { observations: observations.map(encode), ...optionFields(options), seed };
    const response = parseActions<A>(await this.#ask(body, reset, signal), seed);
    this.#last = response;
    return response.actions;
  }

  /**
   * Requests the actions for arrays of numbers in a binary message, which is the fastest format.
   *
   * `inputs`: the policy's inputs in the order of `GET /v2/models/{model}`, each with the values of all rows. For policies
   * without recurrent state: after a reconnection, a recurrent policy would start an episode. `last` does not change.
   */
  async actBinary(
    inputs: readonly NumericArray[],
    { signal, ...options }: BinaryRequestOptions & CallOptions = {},
  ): Promise<BinaryResponse> {
    const message = encodeRequest(inputs, options);
    const { bytes } = await this.#request(() => message, undefined, signal);
    if (!bytes) throw new RemoteError(`${this.#url} did not return a binary message`);
    this.#state = undefined;
    this.#isNew = false;
    const response = decodeResponse(bytes);
    this.#pin(response.version);
    return response;
  }

  /** Closes the connection. The next action opens a new one. */
  close(): void {
    this.#connection?.close();
    this.#connection = undefined;
  }

  async #ask(body: ActionBody, reset: boolean | readonly boolean[], signal?: AbortSignal): Promise<Reply> {
    const reply = await this.#request(() => this.#message(body, reset), toJson(body), signal);
    if (!reply.body || reply.bytes) throw new RemoteError(`${this.#url} did not return JSON`);
    const { state, version } = reply.body as { state?: string | string[]; version: number };
    this.#state = state;
    this.#isNew = false;
    this.#hasState = state !== undefined || this.#follow;
    this.#pin(version);
    return reply;
  }

  /** `body`: of a request over HTTP that tells why a stream is refused; undefined if the message has no such form. */
  async #request(message: () => string | Uint8Array, body: string | undefined, signal?: AbortSignal): Promise<Reply> {
    if (this.#isActing) throw new InvalidInput("an action of this stream is pending: await it before the next one");
    this.#isActing = true;
    try {
      const retries = new Retries(this.#client.retryDeadline);
      for (;;) {
        const outcome = await this.#attempt(message, body, signal);
        const delay = retries.nextDelay(outcome);
        if (delay === undefined) return checked(outcome, this.#url);
        await sleep(delay, signal);
      }
    } catch (error) {
      const retired = this.#last && interrupted(error, `the stream of ${this.#model}`);
      throw retired ?? error;
    } finally {
      this.#isActing = false;
    }
  }

  async #attempt(
    message: () => string | Uint8Array,
    body: string | undefined,
    signal?: AbortSignal,
  ): Promise<Outcome> {
    const limit = AbortSignal.timeout(this.#client.timeout);
    const either = signal ? AbortSignal.any([signal, limit]) : limit;
    try {
      const connection = await this.#open(either);
      return await connection.exchange(message(), either);
    } catch (error) {
      // On the same connection, a late response would be taken for the response to the next message.
      this.close();
      signal?.throwIfAborted();
      if (error instanceof LeagueError) throw error;
      if (error instanceof Refused) return this.#refusal(error, body, signal);
      return error instanceof ConnectionLost ? error : new ConnectionLost(String(error), { cause: error });
    }
  }

  async #open(signal: AbortSignal): Promise<Connection> {
    if (this.#connection?.isOpen) return this.#connection;
    const { key } = this.#client;
    const protocols = key ? ["policy-league", `policy-league.key.${key}`] : [];
    this.#connection = await Connection.open(this.#webSocket, this.#url, protocols, signal);
    this.#isNew = true;
    return this.#connection;
  }

  get #url(): string {
    const { path, version, query } = this.#model;
    // An episode keeps the member of a mixture.
    const member = this.#last ? `&version=${this.#last.version}` : "";
    const followed = `?follow=${version ?? "champion"}${member}`;
    return `ws${this.#client.url.slice("http".length)}${path}/stream${this.#follow ? followed : query}`;
  }

  /** Returns why a stream was refused: a WebSocket does not tell, but a request for an action does. */
  async #refusal(error: Refused, body: string | undefined, signal?: AbortSignal): Promise<Outcome> {
    const outcome = await this.#client.tryAct(this.#model, body ?? '{"observation":null}', signal);
    // What is wrong with a body that stands for another message says nothing about the stream.
    const accepted = body === undefined ? ["invalid_input", "invalid_observation"] : ["invalid_input"];
    const isAccepted =
      outcome instanceof Reply && (outcome.status < 400 || accepted.includes(String(outcome.body?.["code"])));
    return isAccepted ? error : outcome;
  }

  /** The message for a request. The first one of a connection includes the recurrent state. */
  #message(body: ActionBody, reset: boolean | readonly boolean[]): string {
    const message: ActionBody = this.#hasState ? { ...body, return_state: true } : { ...body };
    if (this.#isNew && this.#state !== undefined && reset !== true) {
      const state = this.#state;
      // Rows in which an episode starts have no state.
      message.state = reset && Array.isArray(state) ? state.map((row, i) => (reset[i] ? null : row)) : state;
    } else if (reset) {
      message.reset = reset;
    }
    return toJson(message);
  }

  #pin(version: number): void {
    if (!this.#follow) this.#model = this.#model.at(version);
  }
}
