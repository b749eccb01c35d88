// The games with the least expected results.

import { html } from "./vendor/preact-htm.js";
import { EmptyState, leaguePath, Ref, Table } from "./components.js";
import { number } from "./format.js";

const HEAD = [["Contestant"], ["Did better than"], ["Expected score", "number"], ["Score", "number"], ["Game"]];

export function Upsets({ league, about: { champion, summary } }) {
  const upsets = summary?.upsets ?? [];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Upsets</h2></div>
    <p class="muted">Games in which a contestant scored at least 0.4 more than the ratings predict, at first one per pair of contestants. A win scores 1, a draw 0.5.</p>
    ${upsets.length ? html`<${Table} caption="Upsets, greatest first" head=${HEAD} cls="full">
        ${upsets.map(({ match, game, better, other, expected, score }) => html`<tr key="${match} ${game}">
          <th scope="row"><${Ref} value=${better} champion=${champion} /></th><td><${Ref} value=${other} champion=${champion} /></td>
          <td class="number">${number(expected)}</td><td class="number strong">${number(score)}</td>
          <td><a href=${leaguePath(league, "matches", ...match.split("/"), game)} aria-label="Game ${game} of match ${match}">Show</a></td></tr>`)}
      <//>`
      : html`<${EmptyState}>No upsets yet.<//>`}
  </section>`;
}
