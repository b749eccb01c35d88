// Calls of the API by openapi-fetch, with the types that openapi-typescript generates. It is compiled, not run.
import createClient from "openapi-fetch";
import type { components, paths } from "policy-league-client";

const client = createClient<paths>({ baseUrl: "http://127.0.0.1:8000" });
const league = "connect_four";

const acted = await client.POST("/v1/policies/{model}/action", {
  params: { path: { model: league }, query: { version: "3" } },
  body: { observation: { observation: [[0, 1], [1, 0]], action_mask: [1, 0, 1] } },
});
const action: components["schemas"]["Numbers"] | undefined = acted.data?.action;
const code: string | undefined = acted.error?.code;

const promoted = await client.POST("/v1/leagues/{league}/aliases/{alias}", {
  params: { path: { league, alias: "champion" }, header: { "Idempotency-Key": "a" } },
  body: { version: 3 },
});
const event: number | undefined = promoted.data?.event;

const tournament = await client.POST("/v1/leagues/{league}/evaluations", {
  params: { path: { league }, header: { "Idempotency-Key": "b" } },
  body: { contestants: ["connect_four@3"], blocks: 64 },
});
const nightly = await client.POST("/v1/leagues/{league}/evaluations", {
  params: { path: { league }, header: { "Idempotency-Key": "c" } },
  body: { kind: "nightly" },
});
const evaluations: (number | undefined)[] = [tournament.data?.evaluation, nightly.data?.evaluation];

const game = await client.POST("/v1/leagues/{league}/play", {
  params: { path: { league } },
  body: { opponent: "script:random", agent: "player_0" },
});
const legal: number[] | undefined = game.data?.legal;

const listed = await client.GET("/v1/leagues/{league}/versions", { params: { path: { league } } });
const numbers: number[] | undefined = listed.data?.versions.map((version) => version.version);
const next: number | null | undefined = listed.data?.next;

// @ts-expect-error: there is no such route
await client.GET("/v1/nothing");
await client.POST("/v1/leagues/{league}/aliases/{alias}", {
  params: { path: { league, alias: "champion" }, header: { "Idempotency-Key": "d" } },
  // @ts-expect-error: a version is a number
  body: { version: "3" },
});

export { action, code, evaluations, event, legal, next, numbers };
