// The files of clients/vectors, which the tests of every client encode and decode.
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { test } from "node:test";
import { decodeResponse, encodeArray, encodeRequest, type NumericArray, type Observation } from "policy-league-client";
import { encode, toJson } from "../src/requests.js";
import { derive } from "../src/seeds.js";

interface Tensor {
  dtype: "int8" | "int64" | "float32";
  shape: number[];
  data: number[];
}

interface JsonRequest {
  file: string;
  observation?: unknown;
  observations?: unknown[];
  explore?: boolean;
  seed?: string | string[];
  probabilities?: true;
  state?: string | (string | null)[];
}

interface BinaryRequest {
  file: string;
  inputs: Tensor[];
  rows: number;
  explore?: boolean;
  seed?: string;
  reset: boolean | boolean[];
}

interface Vectors {
  seeds: { seed: string; step: number; derived: string }[];
  requests: JsonRequest[];
  binary_requests: BinaryRequest[];
  binary_responses: { file: string; version: number; rows: number; actions: Tensor }[];
}

const FOLDER = new URL("../../../vectors/", import.meta.url);
const read = (file: string): Buffer => readFileSync(new URL(file, FOLDER));
const vectors: Vectors = JSON.parse(read("vectors.json").toString());

function array({ dtype, data }: Tensor): NumericArray {
  if (dtype === "int8") return new Int8Array(data);
  return dtype === "int64" ? new BigInt64Array(data.map(BigInt)) : new Float32Array(data);
}

/** The value of an observation, with arrays in place of their descriptions. */
function observationOf(value: unknown): Observation {
  if (typeof value !== "object" || value === null || Array.isArray(value)) return value as Observation;
  if ("dtype" in value) return encodeArray(array(value as Tensor), (value as Tensor).shape) as Observation;
  return Object.fromEntries(Object.entries(value).map(([key, part]) => [key, observationOf(part)]));
}

/** A JSON document, with numbers above 2^53 as text. */
function parsed(text: string): unknown {
  return JSON.parse(text.replace(/\b\d{16,}\b(?!")/g, '"$&"'));
}

for (const { file, seed, observation, observations, ...body } of vectors.requests) {
  test(file, () => {
    const text = toJson({
      ...body,
      ...(observation !== undefined && { observation: encode(observationOf(observation)) }),
      ...(observations && { observations: observations.map((row) => encode(observationOf(row))) }),
      ...(seed !== undefined && { seed: typeof seed === "string" ? BigInt(seed) : seed.map(BigInt) }),
    });
    assert.deepEqual(parsed(text), parsed(read(file).toString()));
  });
}

for (const { file, inputs, seed, ...options } of vectors.binary_requests) {
  test(file, () => {
    const message = encodeRequest(inputs.map(array), { ...options, ...(seed !== undefined && { seed: BigInt(seed) }) });
    assert.deepEqual(Buffer.from(message), read(file));
  });
}

for (const { file, version, rows, actions } of vectors.binary_responses) {
  test(file, () => {
    const message = read(file);
    const response = decodeResponse(message.buffer.slice(message.byteOffset, message.byteOffset + message.byteLength) as ArrayBuffer);
    assert.deepEqual([response.version, response.rows], [version, rows]);
    const kind = actions.dtype === "int64" ? BigInt64Array : Float32Array;
    assert.deepEqual(new kind(response.actions), array(actions));
  });
}

test("derived seeds", () => {
  for (const { seed, step, derived } of vectors.seeds) assert.equal(derive(BigInt(seed), step), BigInt(derived));
});

test("reset has a value for each row", () => {
  assert.throws(() => encodeRequest([], { rows: 2, reset: [true] }), /expected 2/);
});
