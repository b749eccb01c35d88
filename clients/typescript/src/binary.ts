/** Binary messages of a stream: a header of 16 bytes followed by arrays, little-endian. */

import { InvalidInput } from "./errors.js";
import { type NumericArray, type Seed, usedSeed } from "./requests.js";

const FORMAT = 1;
const HEADER = 16;
const [EXPLORE, HAS_SEED, RESET, HAS_RESETS, GREEDY] = [1, 2, 4, 8, 16];

/** Options of a binary request. */
export interface BinaryRequestOptions {
  /** Number of observations; default 1. */
  rows?: number;
  /** Start an episode in every row, or in the rows that are true. */
  reset?: boolean | readonly boolean[];
  /** See `ActOptions`. */
  explore?: boolean;
  /** One seed for all rows. By default a random one. */
  seed?: Seed;
}

/** The actions of a binary response. */
export interface BinaryResponse {
  /** The version that answered. */
  version: number;
  /** Number of actions. */
  rows: number;
  /** The actions: 64-bit integers of Discrete and MultiDiscrete spaces, 32-bit floats of a Box. */
  actions: ArrayBuffer;
}

/**
 * Encodes a request.
 *
 * `inputs`: the policy's inputs in the order of `GET /v2/models/{model}`, each with the values of all rows. Throws
 * InvalidInput.
 */
export function encodeRequest(inputs: readonly NumericArray[], options: BinaryRequestOptions = {}): Uint8Array {
  const { rows = 1, reset = false, explore } = options;
  const seed = usedSeed(explore, options.seed);
  const resets = typeof reset === "boolean" ? [] : reset;
  if (typeof reset !== "boolean" && reset.length !== rows) {
    throw new InvalidInput(`reset has ${reset.length} values, expected ${rows}`);
  }
  const size = inputs.reduce((sum, input) => sum + input.byteLength, HEADER + resets.length);
  const message = new Uint8Array(size);
  const header = new DataView(message.buffer);
  const selection = explore === undefined ? 0 : explore ? EXPLORE : GREEDY;
  const flags = selection | (seed === undefined ? 0 : HAS_SEED) | (reset === true ? RESET : 0);
  header.setUint8(0, FORMAT);
  header.setUint8(1, flags | (typeof reset === "boolean" ? 0 : HAS_RESETS));
  header.setUint32(4, rows, true);
  header.setBigUint64(8, BigInt(seed ?? 0), true);
  message.set(resets.map(Number), HEADER);
  let end = HEADER + resets.length;
  for (const input of inputs) {
    message.set(new Uint8Array(input.buffer, input.byteOffset, input.byteLength), end);
    end += input.byteLength;
  }
  return message;
}

/** Decodes a response. */
export function decodeResponse(message: ArrayBuffer): BinaryResponse {
  const header = new DataView(message);
  return {
    version: header.getUint32(8, true),
    rows: header.getUint32(4, true),
    actions: message.slice(HEADER),
  };
}
