import assert from "node:assert/strict";
import { test } from "node:test";
import { encodeArray } from "policy-league-client";
import { encode, toJson, usedSeed } from "../src/requests.js";

test("arrays are sent as their bytes, other values unchanged", () => {
  const observation = { observation: new Float32Array([1, -2]), inner: { mask: [1, 0] }, step: 3, image: { png: "AA" } };
  assert.deepEqual(encode(observation), {
    observation: { b64: "AACAPwAAAMA=", dtype: "float32" },
    inner: { mask: [1, 0] },
    step: 3,
    image: { png: "AA" },
  });
  const part = new BigInt64Array([1n, 2n]).subarray(1);
  assert.deepEqual(encodeArray(part, [1, 1]), { b64: "AgAAAAAAAAA=", dtype: "int64", shape: [1, 1] });
  const large = new Uint8Array(100_000).map((_, i) => i);
  assert.equal(encodeArray(large).b64, Buffer.from(large).toString("base64"));
});

test("seeds have up to 63 bits", () => {
  const seed = 2n ** 63n - 1n;
  assert.equal(toJson({ observation: 1, explore: undefined, seed }), '{"observation":1,"seed":9223372036854775807}');
  assert.equal(toJson({ observations: [1, 2], seed: [7, seed] }), '{"observations":[1,2],"seed":[7,9223372036854775807]}');
});

test("a request for greedy actions has no seed, others have one", () => {
  assert.equal(usedSeed(false, 7), undefined);
  assert.equal(usedSeed(undefined, 7), 7);
  assert.deepEqual(usedSeed(true, [1, 2]), [1, 2]);
  assert.notEqual(usedSeed(true, undefined), usedSeed(true, undefined));
});
