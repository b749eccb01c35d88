// Acts over HTTP, in episodes and over streams until its standard input ends. Prints the number of actions now and then,
// and at the end a JSON document. Argument: the URL of a server with the leagues `board` and `memory`.
import { Client, type Observation } from "policy-league-client";

const client = new Client(process.argv[2]);
const board: Observation = { observation: new Int8Array(6 * 7 * 2), action_mask: [1, 1, 1, 1, 1, 1, 1] };
const one = new Float32Array([1]);
const actions = { http: 0, episodes: 0, streams: 0 };
const failures: string[] = [];
let isOver = false;
process.stdin.on("end", () => (isOver = true)).resume();

async function repeat(kind: keyof typeof actions, act: () => Promise<unknown>): Promise<void> {
  while (!isOver) {
    try {
      await act();
      actions[kind] += 1;
      if (kind === "streams" && actions.streams % 50 === 0) console.log(actions.streams);
    } catch (error) {
      failures.push(String(error));
    }
  }
}

/** Three actions of the policy that counts its steps, of which the third is 1. */
async function count(act: (isFirst: boolean) => Promise<unknown>): Promise<void> {
  const counted = [await act(true), await act(false), await act(false)];
  if (counted.join() !== "0,0,1") throw new Error(`the recurrent state was lost: ${counted}`);
}

const streams = Array.from({ length: 6 }, () => client.stream<number>("memory"));
await Promise.all([
  ...Array.from({ length: 4 }, () => repeat("http", () => client.act("board", board))),
  repeat("http", () => client.actBatch("board@champion", [board, board])),
  repeat("episodes", () => {
    const episode = client.episode<number>("memory");
    return count(() => episode.act(one));
  }),
  ...streams.map((stream) => repeat("streams", () => count((reset) => stream.act(one, { reset })))),
]);
for (const stream of streams) stream.close();
console.log(JSON.stringify({ actions, failures }));
