/** Episodes over HTTP, in which one version chooses every action. */

import type { ActOptions, Client } from "./client.js";
import { interrupted } from "./errors.js";
import type { Model } from "./references.js";
import type { Observation, Seed } from "./requests.js";
import type { Action, ActionResponse } from "./responses.js";
import { derive } from "./seeds.js";

/** Options of an episode. */
export interface EpisodeOptions {
  /** See `ActOptions`. */
  explore?: boolean;
  /** Seed of the episode. The seed of step t is derived from it and t. */
  seed?: Seed;
}

/**
 * An episode of one agent, created by `Client.episode`.
 *
 * The version that answers the first request answers all of them, even if another version is promoted meanwhile. Wait
 * for each action before you request the next one.
 */
export class Episode<A extends Action = Action> {
  readonly #client: Client;
  readonly #options: EpisodeOptions;
  #model: Model;
  #last: ActionResponse<A> | undefined;
  #steps = 0;

  /** @internal */
  constructor(client: Client, model: Model, options: EpisodeOptions) {
    this.#client = client;
    this.#model = model;
    this.#options = options;
  }

  /** The version that answers; undefined before the first action. */
  get version(): number | undefined {
    return this.#last?.version;
  }

  /** The last response, with digest, seed and probabilities; undefined before the first action. */
  get last(): ActionResponse<A> | undefined {
    return this.#last;
  }

  /** Number of actions so far. */
  get steps(): number {
    return this.#steps;
  }

  /**
   * Requests the next action.
   *
   * Throws VersionRetired if the version that started the episode is not served any more.
   */
  async act(observation: Observation, options: Omit<ActOptions, "explore" | "seed" | "state"> = {}): Promise<A> {
    const { explore, seed } = this.#options;
    try {
      this.#last = await this.#client.act<A>(this.#model.toString(), observation, {
        ...options,
        ...(explore !== undefined && { explore }),
        ...(seed !== undefined && { seed: derive(seed, this.#steps) }),
        ...(this.#last?.state !== undefined && { state: this.#last.state }),
      });
    } catch (error) {
      const retired = this.#steps ? interrupted(error, `the episode of ${this.#model}`) : undefined;
      throw retired ?? error;
    }
    this.#model = this.#model.at(this.#last.version);
    this.#steps += 1;
    return this.#last.action;
  }
}
