// The leaderboard of a league, overall and by side.

import { html } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { useChangeToken, useOffsetList } from "./data.js";
import { Await, EmptyState, leaguePath, Ref, ShowMore, Table } from "./components.js";
import { EarlierResults } from "./earlier.js";
import { Live } from "./report.js";
import { Term } from "./term.js";
import { useAddress } from "./router.js";
import { count, interval, number, percent, plural, searched, signed } from "./format.js";

export function Leaderboard({ league, about }) {
  const { parameters } = useAddress();
  const [side, game] = [parameters.get("side"), parameters.get("game")];
  const rows = useOffsetList(query(apiPath(league, "leaderboard"), { side, game }), "leaderboard", useChangeToken("computed_at", "aliases"));
  const sides = rows.page?.sides ?? [];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Leaderboard</h2>
      ${sides.length > 1 && html`<nav class="choice" aria-label="Sides"><ul>
        <li><a href=${query(leaguePath(league), { game })} aria-current=${side ? null : "true"}>All sides</a></li>
        ${sides.map((each) => html`<li><a href=${query(leaguePath(league), { side: each, game })} aria-current=${each === side ? "true" : null}>${each}</a></li>`)}
      </ul></nav>`}
    </div>
    <${EarlierResults} league=${league} summary=${about.summary} game=${game} />
    ${rows.page?.not_champion && html`<p>${rows.page.not_champion}</p>`}
    <${Await} result=${rows}>${rows.items && html`<${Rows} league=${league} rows=${rows.items} champion=${about.champion} isComputed=${!!rows.page.computed_at && about.up_to_date} />`}<//>
    <${ShowMore} list=${rows} />
    ${rows.items?.length > 0 && html`<p class="muted small">${plural(rows.page.total, "contestant")}. Ratings are Elo above <code>script:random</code>, with 95 % intervals.</p>`}
  </section>`;
}

function Rows({ league, rows, champion, isComputed }) {
  if (!rows.length) {
    return html`<${EmptyState}>${isComputed
      ? html`No games yet. <${Live}><a href=${leaguePath(league, "evaluations", "new")}>Start an evaluation</a> to rate the versions.<//>`
      : "The leaderboard has not been computed yet. The evaluation service computes it a few seconds after new games."}<//>`;
  }
  const hasReturn = rows.some((row) => row.mean_return != null);
  const range = ratingRange(rows);
  const head = [["Rank", "number"], ["Contestant"], [html`<${Term} name="rating">Rating<//>`, "number"], ["95 % interval"], ["Rating chart", "interval-cell", true],
    ["Score", "number"], hasReturn && ["Mean return", "number"], ["Games", "number"]].filter(Boolean);
  return html`<${Table} caption="Leaderboard" head=${head} cls="full">
    ${rows.map((row, index) => html`<tr key=${row.ref} class=${row.ref === `${league}@${champion}` ? "champion-row" : ""}>
      <td class="number muted">${row.rank ?? index + 1}</td>
      <th scope="row"><${Ref} value=${row.ref} champion=${champion} />
        ${row.search && html` <span class="muted small">search with ${searched(row.search)}</span>`}</th>
      <td class="number strong">${signed(row.rating)}</td>
      <td class="nowrap muted">${interval(row.interval)}</td>
      <td class="interval-cell"><${IntervalPlot} row=${row} range=${range} /></td>
      <td class="number">${percent(row.score)}</td>
      ${hasReturn && html`<td class="number">${number(row.mean_return)}</td>`}
      <td class="number">${count(row.games)}</td>
    </tr>`)}
  <//>`;
}

function ratingRange(rows) {
  const ends = rows.filter((row) => row.rating != null).flatMap((row) => [row.rating, ...(row.interval ?? [])]).filter((end) => end != null);
  return [Math.min(0, ...ends), Math.max(1, ...ends)];
}

/** A rating and its interval, on an axis that all rows share. */
function IntervalPlot({ row, range: [low, high] }) {
  if (row.rating == null) return null;
  const x = (value) => 4 + (152 * (value - low)) / (high - low);
  return html`<svg class="interval-plot" viewBox="0 0 160 16" width="160" height="16" aria-hidden="true">
    <line class="zero" x1=${x(0)} x2=${x(0)} y1="0" y2="16" />
    ${row.interval && html`<line class="span" x1=${x(row.interval[0])} x2=${x(row.interval[1])} y1="8" y2="8" />`}
    <circle cx=${x(row.rating)} cy="8" r="3.5" />
  </svg>`;
}
