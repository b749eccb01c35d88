/** Simulators: games that run in programs of their own, and play episodes for training runs and evaluations. */

import type { CallOptions, Client } from "./client.js";
import { InvalidInput, LeagueError, RemoteError } from "./errors.js";
import { leaguePath } from "./references.js";
import { encode, type Observation } from "./requests.js";
import type { Action } from "./responses.js";
import { ConnectionLost, sleep } from "./retries.js";
import { Refused, type WebSocketConstructor, type WebSocketLike } from "./web_socket.js";

const PROTOCOL = 1;
/** Milliseconds between two attempts to connect while nothing needs episodes. */
const WAIT = 5000;
const FIRST_DELAY = 500;

/** What an agent is told. Without a flag it must act next; with one, it has left the episode. */
export interface Report {
  agent: string;
  observation: Observation;
  /** Sum of the agent's rewards since its previous report; default 0. */
  reward?: number;
  /** The agent has left because of the rules of the game. */
  terminated?: boolean;
  /** The agent has left for another reason, such as a time limit. */
  truncated?: boolean;
}

/** A game that `Client.simulate` drives. An episode is over when no agent must act. */
export interface SimulatedGame<A extends Action = Action> {
  /** Starts an episode. Returns the reports of the agents that must act first. */
  reset(seed: number): Report[];
  /**
   * Continues with the actions of all agents that must act: agent → action. Returns the next reports, and those of agents
   * that leave. At the end of an episode each agent that has acted gets a last report.
   */
  step(actions: Record<string, A>): Report[];
}

export interface SimulatorOptions extends CallOptions {
  /** Name of the simulator, `environment.external.simulator` of the league. */
  name: string;
  /** Its version, `environment.external.version` of the league. */
  version: string;
  /** Number of games that are played at the same time; default 1. */
  episodes?: number;
  /** Number of episodes after which to stop; by default it plays for ever. */
  limit?: number;
}

interface Playing<A extends Action> {
  game: SimulatedGame<A>;
  waiting: Set<string>;
  actions: Record<string, A>;
}

type Message =
  | { type: "welcome" }
  | { type: "play"; episodes: { episode: number; seed: number }[] }
  | { type: "actions"; actions: { episode: number; agent: string; action: Action }[] }
  | { type: "abandon"; episodes: number[] }
  | { type: "error"; code: string; message: string };

/** Plays episodes until the limit is reached or the signal is aborted. See `Client.simulate`. */
export async function simulate<A extends Action>(
  client: Client,
  league: string,
  makeGame: () => SimulatedGame<A>,
  kind: WebSocketConstructor,
  { limit = Infinity, signal, ...options }: SimulatorOptions,
): Promise<void> {
  const spare: SimulatedGame<A>[] = [];
  let remaining = limit;
  let delay = FIRST_DELAY;
  while (remaining > 0) {
    signal?.throwIfAborted();
    const table = new Table<A>(makeGame, spare, remaining);
    try {
      await table.play(client, league, kind, options, signal);
    } catch (error) {
      signal?.throwIfAborted();
      if (!(error instanceof ConnectionLost)) throw error;
      // A WebSocket does not tell why it was refused, but this request does.
      if (error instanceof Refused) await client.simulations(league, signal ? { signal } : {}).catch(throwUnlessTemporary);
    }
    spare.push(...table.games());
    delay = table.over > 0 ? FIRST_DELAY : Math.min(2 * delay, WAIT);
    remaining -= table.over;
    if (remaining > 0) await sleep(delay, signal);
  }
}

/** The games of one connection. */
class Table<A extends Action> {
  /** The number of episodes that are over. */
  over = 0;
  readonly #makeGame: () => SimulatedGame<A>;
  readonly #spare: SimulatedGame<A>[];
  readonly #limit: number;
  readonly #playing = new Map<number, Playing<A>>();

  constructor(makeGame: () => SimulatedGame<A>, spare: SimulatedGame<A>[], limit: number) {
    this.#makeGame = makeGame;
    this.#spare = spare.splice(0);
    this.#limit = limit;
  }

  /** All games, for the next connection. */
  games(): SimulatedGame<A>[] {
    return [...this.#spare, ...[...this.#playing.values()].map(({ game }) => game)];
  }

  /** Plays until the limit is reached. Rejects when the connection ends before. */
  play(
    client: Client,
    league: string,
    kind: WebSocketConstructor,
    { name, version, episodes = 1 }: SimulatorOptions,
    signal: AbortSignal | undefined,
  ): Promise<void> {
    const protocols = client.key ? ["policy-league", `policy-league.key.${client.key}`] : [];
    const url = `ws${client.url.slice("http".length)}${leaguePath(league)}/simulate`;
    const ended = new AbortController();
    return new Promise<void>((resolve, reject) => {
      const socket: WebSocketLike = new kind(url, protocols);
      let isOpen = false;
      const fail = (error: unknown): void => {
        socket.close();
        reject(error);
      };
      signal?.addEventListener("abort", () => fail(signal.reason), { signal: ended.signal });
      socket.addEventListener("open", () => {
        isOpen = true;
        const hello = { type: "hello", protocol: PROTOCOL, simulator: { name, version }, episodes };
        socket.send(JSON.stringify(hello));
      });
      socket.addEventListener("message", ({ data }) => {
        try {
          const reports = this.#process(JSON.parse(String(data)) as Message);
          if (reports !== undefined) socket.send(reports);
          if (this.over >= this.#limit) socket.close(); // after the last reports
        } catch (error) {
          fail(error);
        }
      });
      socket.addEventListener("close", ({ code, reason }) => {
        const text = `the simulator's connection was closed with code ${code}${reason && `: ${reason}`}`;
        if (this.over >= this.#limit) resolve();
        else if (!isOpen) reject(new Refused(text));
        else reject(code === 1008 || code === 1007 || code === 1009 ? new RemoteError(text) : new ConnectionLost(text));
      });
      socket.addEventListener("error", () => {
        if (this.over >= this.#limit) resolve();
        else if (!isOpen) reject(new Refused("the simulator was refused"));
      });
    }).finally(() => ended.abort());
  }

  /** Processes a message. Returns the message with the reports that follow, if any. */
  #process(message: Message): string | undefined {
    const reports: Record<string, unknown>[] = [];
    const over: number[] = [];
    switch (message.type) {
      case "play":
        for (const { episode, seed } of message.episodes) {
          const game = this.#spare.pop() ?? this.#makeGame();
          const playing: Playing<A> = { game, waiting: new Set(), actions: {} };
          this.#playing.set(episode, playing);
          read(episode, playing, game.reset(seed), reports, over);
        }
        break;
      case "actions": {
        const ready: [number, Playing<A>][] = [];
        for (const { episode, agent, action } of message.actions) {
          const playing = this.#playing.get(episode);
          if (playing === undefined) continue; // it was abandoned
          playing.actions[agent] = action as A;
          playing.waiting.delete(agent);
          if (playing.waiting.size === 0) ready.push([episode, playing]);
        }
        for (const [episode, playing] of ready) {
          const { actions } = playing;
          playing.actions = {};
          read(episode, playing, playing.game.step(actions), reports, over);
        }
        break;
      }
      case "abandon":
        message.episodes.forEach((episode) => this.#free(episode));
        break;
      case "error":
        throw new InvalidInput(message.message, { code: message.code });
    }
    over.forEach((episode) => this.#free(episode));
    this.over += over.length;
    return reports.length > 0 ? JSON.stringify({ type: "reports", reports, over }) : undefined;
  }

  #free(episode: number): void {
    const playing = this.#playing.get(episode);
    if (playing === undefined) return;
    this.#playing.delete(episode);
    this.#spare.push(playing.game);
  }
}

/** Adds what a game has returned. */
function read<A extends Action>(
  episode: number,
  playing: Playing<A>,
  returned: Report[],
  reports: Record<string, unknown>[],
  over: number[],
): void {
  for (const { observation, ...report } of returned) {
    reports.push({ episode, ...report, observation: encode(observation) });
    if (!(report.terminated || report.truncated)) playing.waiting.add(report.agent);
  }
  if (playing.waiting.size === 0) over.push(episode);
}

function throwUnlessTemporary(error: unknown): void {
  const status = error instanceof LeagueError ? error.status : undefined;
  if (status !== undefined && status >= 400 && status < 500 && status !== 429) throw error;
}
