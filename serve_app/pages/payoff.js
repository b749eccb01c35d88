// Who beats whom: a heat map of mean scores, of which each cell leads to the matches behind it.

import { html } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { useData, useMark } from "./data.js";
import { Await, Empty, league as at } from "./parts.js";
import { useAddress } from "./router.js";
import { several, tail } from "./words.js";

const SHADES = 11;

export function Payoff({ league, about }) {
  const payoff = useData(of(league, "payoff"), useMark("computed_at"));
  const side = useAddress().parameters.get("side");
  const table = payoff.data && (payoff.data.payoff ?? (payoff.data.contestants ? payoff.data : null));
  const sides = Object.keys(table?.by_side ?? {});
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Who beats whom</h2>
      ${sides.length > 1 && html`<nav class="choice" aria-label="Sides"><ul>
        <li><a href=${at(league, "payoff")} aria-current=${side ? null : "true"}>All games</a></li>
        ${sides.map((each) => html`<li><a href=${query(at(league, "payoff"), { side: each })} aria-current=${each === side ? "true" : null}>as ${each}</a></li>`)}
      </ul></nav>`}
    </div>
    <${Await} of=${payoff}>${payoff.data && (table
      ? html`<${Heat} league=${league} of=${table} scores=${table.by_side?.[side] ?? table.score} champion=${about.champion} />`
      : html`<${Empty}>Nobody has met anybody yet. <a href=${at(league, "evaluations", "new")}>Start an evaluation</a> to see.<//>`)}<//>
  </section>`;
}

function Heat({ league, of: { contestants, games }, scores, champion }) {
  const crowd = contestants.length > 16;
  return html`
    <p class="soft">Each cell is the row's mean score against the column, in per cent: 50 is even. A cell leads to its matches.</p>
    <div class="wide" tabindex="0" role="region" aria-label="Mean scores">
      <table class="heat ${crowd ? "crowd" : ""}">
        <caption class="unseen">Mean score of each row's contestant against each column's, in per cent</caption>
        <thead><tr><td></td>${contestants.map((ref) => html`<th scope="col" title=${ref}><span>${tail(ref).replace("script:", "")}</span></th>`)}</tr></thead>
        <tbody>${contestants.map((ref, row) => html`<tr>
          <th scope="row" title=${ref}>${tail(ref)}${ref === `${league}@${champion}` && html`<span class="star" title="champion"><span aria-hidden="true"> ★</span><span class="unseen"> champion</span></span>`}</th>
          ${contestants.map((other, column) => html`<${Cell} league=${league} row=${ref} column=${other} score=${row === column ? null : scores[row][column]} games=${games[row][column]} />`)}
        </tr>`)}</tbody>
      </table>
    </div>
    <p class="key" aria-hidden="true"><span>always loses</span>${Array.from({ length: SHADES }, (_, shade) => html`<i class="h${shade}"></i>`)}<span>always wins</span></p>`;
}

function Cell({ league, row, column, score, games }) {
  if (score == null) return html`<td class="none">${row === column ? "" : html`<span class="unseen">have not met</span>`}</td>`;
  const words = `${row} scores ${Math.round(100 * score)} % against ${column} in ${several(games, "game")}`;
  return html`<td class="h${Math.min(SHADES - 1, Math.round(score * (SHADES - 1)))}">
    <a href=${query(at(league, "matches"), { first: row, second: column })} title=${words} aria-label="${words}: the matches">${Math.round(100 * score)}</a></td>`;
}
