/** Client for a policy server of Policy League. */

export { type BinaryRequestOptions, type BinaryResponse, decodeResponse, encodeRequest } from "./binary.js";
export * from "./client.js";
export type { Episode, EpisodeOptions } from "./episode.js";
export {
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
} from "./errors.js";
export type { components, operations, paths } from "./openapi.js";
export { encodeArray, type NumericArray, type Observation, type ResponseOptions, type Seed } from "./requests.js";
export type { Action, ActionResponse, Analysis, BatchActionResponse, Origin, Probabilities } from "./responses.js";
export type { Report, SimulatedGame, SimulatorOptions } from "./simulator.js";
export type { Stream, StreamActBatchOptions, StreamActOptions } from "./stream.js";
export type { WebSocketConstructor } from "./web_socket.js";
