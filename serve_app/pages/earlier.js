// Results from before the game of a league changed: what changed, and where they are.

import { html } from "./vendor/preact-htm.js";
import { query } from "./api.js";
import { leaguePath } from "./components.js";
import { dateTime, plural } from "./format.js";

/** A notice if there are results of earlier games. `game` names those that the page shows; `page` is its path in the league. */
export function EarlierResults({ league, summary, game, page = "" }) {
  const earlier = summary?.earlier ?? [];
  if (!earlier.length) return null;
  const own = page ? leaguePath(league, page) : leaguePath(league);
  const shown = earlier.find((each) => each.name === game);
  if (shown) {
    return html`<div class="notice" role="status"><p><strong>These are results of an earlier game</strong>, ${period(shown)}. They do not count today.</p>
      <a href=${own}>Show current results</a><${Changes} of=${shown} /></div>`;
  }
  return html`<details class="notice"><summary><strong>The game of this league has changed.</strong> Earlier results are kept apart: they count in no rating, payoff or verdict.</summary>
    <ul>${earlier.map((each) => html`<li key=${each.name}><a href=${query(own, { game: each.name })}>${plural(each.matches, "match", "matches")}</a>, ${period(each)}. <${Changes} of=${each} /></li>`)}</ul>
  </details>`;
}

const period = ({ replaced_at: at, actions }) => `with ${actions} actions${at ? `, until ${dateTime(at)}` : ""}`;

/** What differs between an earlier game and the current one. */
function Changes({ of: { changes, actions_changed: actionsChanged, actions } }) {
  const parts = changes.map(({ name, before, now }) => html`<li key=${name}><code>${name}</code>: ${before ?? "none"} → ${now ?? "none"}</li>`);
  if (actionsChanged) parts.push(html`<li key="actions"><code>play.actions</code>: ${actions} → ${actions === "greedy" ? "sampled" : "greedy"}</li>`);
  return html`<ul>${parts}</ul>`;
}
