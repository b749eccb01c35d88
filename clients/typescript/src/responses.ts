/** The responses to action requests. */

import type { components } from "./openapi.js";
import type { Seed } from "./requests.js";
import type { Reply } from "./retries.js";

type Schemas = components["schemas"];

/** An action in the environment's format: a number, or (nested) lists of numbers. */
export type Action = Schemas["Numbers"];

/** Discrete: a list of probabilities. MultiDiscrete: a list of such lists. Box: `mean` and `std`. */
export type Probabilities = Schemas["Probabilities"];

/** What a search expects in a position: the value for the agent that must act, visits per action, the moves. */
export type Analysis = Schemas["Analysis"];

/** Which version answered. */
export interface Origin {
  /** The version that chose the action. */
  version: number;
  /** Digest of the version's manifest. */
  sha256: string;
  /** The replica that answered; undefined for a response of a stream. */
  replica: string | undefined;
}

/** An action and its origin. */
export interface ActionResponse<A extends Action = Action> extends Origin {
  action: A;
  /** The seed with which the action was sampled, unless it is greedy; undefined with `explore: false`. */
  seed: Seed | undefined;
  /** Action probabilities, if requested. */
  probabilities: Probabilities | undefined;
  /** Recurrent state for the next observation; undefined for policies without state. */
  state: string | undefined;
  /** Positions that a search version evaluated besides the current one; undefined for other versions. */
  simulations: number | undefined;
  /** What the search expects, if requested. */
  analysis: Analysis | undefined;
}

/** The actions for a batch of observations, from one version. */
export interface BatchActionResponse<A extends Action = Action> extends Origin {
  /** The actions, in the order of the observations. */
  actions: A[];
  /** One seed for the batch, or one for each observation. */
  seed: Seed | readonly Seed[] | undefined;
  /** Action probabilities of each observation, if requested. */
  probabilities: Probabilities[] | undefined;
  /** Recurrent state of each observation. */
  state: string[] | undefined;
  /** Those of each observation; undefined unless a search version answered. */
  simulations: number[] | undefined;
  /** What the search expects in each position, if requested. */
  analysis: Analysis[] | undefined;
}

/** Returns the response in a reply. */
export function parseAction<A extends Action>(reply: Reply, seed: Seed | undefined): ActionResponse<A> {
  const body = reply.body as Schemas["ActionResponse"];
  return {
    action: body.action as A,
    version: body.version,
    sha256: body.sha256,
    replica: reply.replica,
    seed,
    probabilities: body.probabilities as Probabilities | undefined,
    state: body.state as string | undefined,
    simulations: body.simulations as number | undefined,
    analysis: body.analysis as Analysis | undefined,
  };
}

/** Returns the response to a batch in a reply. */
export function parseActions<A extends Action>(
  reply: Reply,
  seed: Seed | readonly Seed[] | undefined,
): BatchActionResponse<A> {
  const body = reply.body as Schemas["ActionResponse"];
  return {
    actions: body.actions as A[],
    version: body.version,
    sha256: body.sha256,
    replica: reply.replica,
    seed,
    probabilities: body.probabilities as Probabilities[] | undefined,
    state: body.state as string[] | undefined,
    simulations: body.simulations as number[] | undefined,
    analysis: body.analysis as Analysis[] | undefined,
  };
}
