/** Bodies of action requests: encodes observations as JSON. */

import { InvalidInput } from "./errors.js";
import type { components } from "./openapi.js";

type Schemas = components["schemas"];

/** Arrays of numbers whose bytes are sent unchanged, in row-major order. */
export type NumericArray =
  | Int8Array
  | Uint8Array
  | Uint8ClampedArray
  | Int16Array
  | Uint16Array
  | Int32Array
  | Uint32Array
  | BigInt64Array
  | BigUint64Array
  | Float32Array
  | Float64Array;

/**
 * An observation as the environment returns it: a number, nested lists, an array, or an object of these, for example
 * with the keys `observation` and `action_mask`. A typed array must have the type of the space, and contains the values
 * in row-major order. An image may also be sent as PNG: `{ png: "…" }`.
 */
export type Observation = Schemas["Observation"] | NumericArray | { [key: string]: Observation };

/** A seed below 2^63. */
export type Seed = number | bigint;

/** Fields of the body of an action request, before it is serialized. */
export interface ActionBody {
  observation?: unknown;
  observations?: unknown[];
  explore?: boolean | undefined;
  probabilities?: true;
  deadline_ms?: number | undefined;
  analysis?: true;
  state?: string | null | readonly (string | null)[] | undefined;
  reset?: boolean | readonly boolean[];
  return_state?: true;
  seed?: Seed | readonly Seed[] | undefined;
}

/** What a request for actions asks for, without its observations. */
export interface ResponseOptions {
  /**
   * Sample the action from the policy's distribution (true), or take the most likely one (false). By default, actions
   * are selected as in the league's matches.
   */
  explore?: boolean | undefined;
  /** Include the action probabilities in the response. */
  probabilities?: boolean | undefined;
  /** Milliseconds after which a search version plays the best action so far. Others ignore it. */
  deadlineMs?: number | undefined;
  /** Include what the search expects in the response. Requires a search version. */
  analysis?: boolean | undefined;
}

const DTYPES: Record<string, string> = {
  Int8Array: "int8",
  Uint8Array: "uint8",
  Uint8ClampedArray: "uint8",
  Int16Array: "int16",
  Uint16Array: "uint16",
  Int32Array: "int32",
  Uint32Array: "uint32",
  BigInt64Array: "int64",
  BigUint64Array: "uint64",
  Float32Array: "float32",
  Float64Array: "float64",
};

/**
 * Returns an array as the server reads it: base64, with the type of the numbers.
 *
 * `shape`: is checked by the server; without it, only the number of bytes is.
 */
export function encodeArray(array: NumericArray, shape?: readonly number[]): Schemas["EncodedArray"] {
  const dtype = DTYPES[array[Symbol.toStringTag]];
  if (dtype === undefined) throw new InvalidInput(`a ${array[Symbol.toStringTag]} cannot be encoded, expected numbers`);
  return { b64: base64(array), dtype, ...(shape && { shape: [...shape] }) };
}

/** Returns the JSON value of an observation. */
export function encode(observation: Observation): unknown {
  if (ArrayBuffer.isView(observation)) return encodeArray(observation);
  if (typeof observation !== "object" || Array.isArray(observation)) return observation;
  return Object.fromEntries(Object.entries(observation).map(([key, part]) => [key, encode(part as Observation)]));
}

/**
 * Returns the seed of a request: a random one if none is requested, so that a repeated request has the same result.
 *
 * Requests for greedy actions have none. The league may sample by default.
 */
export function usedSeed<S extends Seed | readonly Seed[]>(
  explore: boolean | undefined,
  seed: S | undefined,
): S | number | undefined {
  if (explore === false) return undefined;
  return seed ?? Math.floor(Math.random() * Number.MAX_SAFE_INTEGER);
}

/** Returns the fields of a body that ask for something else than by default. */
export function optionFields({ explore, probabilities, deadlineMs, analysis }: ResponseOptions): ActionBody {
  return {
    explore,
    deadline_ms: deadlineMs,
    ...(probabilities && { probabilities }),
    ...(analysis && { analysis }),
  };
}

/** Serializes the body of a request. */
export function toJson({ seed, ...body }: ActionBody): string {
  const text = JSON.stringify(body);
  // JSON.stringify writes no bigint.
  return seed === undefined ? text : `${text.slice(0, -1)},"seed":${Array.isArray(seed) ? `[${seed}]` : seed}}`;
}

function base64(array: ArrayBufferView): string {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  const parts: string[] = [];
  // fromCharCode has a limited number of arguments.
  for (let start = 0; start < bytes.length; start += 0x8000) {
    parts.push(String.fromCharCode(...bytes.subarray(start, start + 0x8000)));
  }
  return btoa(parts.join(""));
}
