// Requests actions for connect four: one, a batch, an episode and a stream. Arguments: the URL of the server, and the
// number of actions of the stream.

import { Client } from "policy-league-client";

const [url = "http://127.0.0.1:8000", ticks = "10"] = process.argv.slice(2);
const board = { observation: new Int8Array(6 * 7 * 2), action_mask: [1, 1, 1, 1, 1, 1, 1] };

const client = new Client(url);
const answer = await client.act<number>("connect_four", board);
console.log(`version ${answer.version} plays column ${answer.action}`);

const batch = await client.actBatch<number>("connect_four@champion", [board, board], { explore: true, seed: 7 });
console.log(`sampled: ${batch.actions.join(", ")}`);

const episode = client.episode<number>("connect_four");
const stream = client.stream<number>("connect_four");
for (let tick = 0; tick < Number(ticks); tick++) {
  console.log(`tick ${tick}: ${await stream.act(board, { reset: tick === 0 })} ${await episode.act(board)}`);
}
stream.close();
console.log(`${ticks} actions of version ${stream.version}, ${episode.steps} of version ${episode.version}`);
