/** Derives seeds as the Python client does: with NumPy's SeedSequence (O'Neill's seed_seq). */

const POOL = 4;
const MASK = 0xffffffffn;

/**
 * Returns a seed below 2^63 that depends on `seed` and `step`.
 *
 * The same as `int(numpy.random.SeedSequence(seed, spawn_key=[step]).generate_state(1, numpy.uint64)[0]) >> 1`.
 */
export function derive(seed: number | bigint, step: number): bigint {
  const entropy = words(BigInt(seed));
  while (entropy.length < POOL) entropy.push(0);
  entropy.push(...words(BigInt(step)));
  const pool = mixed(entropy);
  let constant = 0x8b51f9dd;
  const state = pool.slice(0, 2).map((word) => {
    const value = word ^ constant;
    constant = Math.imul(constant, 0x58f38ded);
    return folded(Math.imul(value, constant));
  });
  return ((BigInt(state[1] ?? 0) << 32n) | BigInt(state[0] ?? 0)) >> 1n;
}

function mixed(entropy: number[]): number[] {
  let constant = 0x43b0d7e5;
  const hash = (word: number): number => {
    const value = word ^ constant;
    constant = Math.imul(constant, 0x931e8875);
    return folded(Math.imul(value, constant));
  };
  const mix = (x: number, y: number): number => folded(Math.imul(0xca01f9dd, x) - Math.imul(0x4973f715, y));
  const pool = entropy.slice(0, POOL).map(hash);
  for (let source = 0; source < entropy.length; source++) {
    for (let target = 0; target < POOL; target++) {
      if (source === target) continue;
      const word = source < POOL ? pool[source] : entropy[source];
      pool[target] = mix(pool[target] ?? 0, hash(word ?? 0));
    }
  }
  return pool;
}

/** The 32-bit words of a number, the lowest first. */
function words(value: bigint): number[] {
  const low = [Number(value & MASK)];
  return value > MASK ? low.concat(words(value >> 32n)) : low;
}

/** An unsigned 32-bit number, combined with its upper half. */
function folded(value: number): number {
  return (value ^ (value >>> 16)) >>> 0;
}
