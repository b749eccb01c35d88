// The payoff matrix: a heatmap of mean scores. Each cell links to the matches of its pair.

import { html } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { hasOneSide, useChangeToken, useData } from "./data.js";
import { Await, EmptyState, leaguePath, Ref, Table } from "./components.js";
import { EarlierResults } from "./earlier.js";
import { Live, report } from "./report.js";
import { useAddress } from "./router.js";
import { plural, shortRef, signed } from "./format.js";

const SHADES = 11;

export function Payoff({ league, about }) {
  const { parameters } = useAddress();
  const [side, game] = [parameters.get("side"), parameters.get("game")];
  const payoff = useData(query(apiPath(league, "payoff"), { game }), useChangeToken("computed_at"));
  const table = payoff.data && (payoff.data.payoff ?? (payoff.data.contestants ? payoff.data : null));
  const sides = Object.keys(table?.by_side ?? {});
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Payoff matrix</h2>
      ${sides.length > 1 && html`<nav class="choice" aria-label="Sides"><ul>
        <li><a href=${query(leaguePath(league, "payoff"), { game })} aria-current=${side ? null : "true"}>All games</a></li>
        ${sides.map((each) => html`<li><a href=${query(leaguePath(league, "payoff"), { side: each, game })} aria-current=${each === side ? "true" : null}>as ${each}</a></li>`)}
      </ul></nav>`}
    </div>
    <${EarlierResults} league=${league} summary=${about.summary} game=${game} page="payoff" />
    <${Await} result=${payoff}>${payoff.data && (table
      ? html`<${Heatmap} league=${league} payoff=${table} scores=${table.by_side?.[side] ?? table.score} champion=${about.champion} relation=${hasOneSide(about) ? "compared with" : "against"} />
          ${table.shares?.length > 0 && html`<${Shares} shares=${table.shares} champion=${about.champion} />`}`
      : html`<${EmptyState}>${about.up_to_date
          ? html`No games yet. <${Live}><a href=${leaguePath(league, "evaluations", "new")}>Start an evaluation</a> to compare the versions.<//>`
          : "The payoff matrix has not been computed yet. The evaluation service computes it a few seconds after new games."}<//>`)}<//>
  </section>`;
}

function Heatmap({ league, payoff: { contestants, games }, scores, champion, relation }) {
  const isDense = contestants.length > 16;
  return html`
    <p class="muted">Each cell shows the mean score of the row ${relation} the column in percent; 50 is even. <${Live}>Select a cell to see its matches.<//></p>
    <div class="wide" tabindex="0" role="region" aria-label="Mean scores">
      <table class="heatmap ${isDense ? "dense" : ""}">
        <caption class="visually-hidden">Mean score of each row ${relation} each column, in percent</caption>
        <thead><tr><td></td>${contestants.map((ref) => html`<th scope="col" title=${ref}><span>${shortRef(ref).replace("script:", "")}</span></th>`)}</tr></thead>
        <tbody>${contestants.map((ref, row) => html`<tr>
          <th scope="row" title=${ref}>${shortRef(ref)}${ref === `${league}@${champion}` && html`<span class="star" title="champion"><span aria-hidden="true"> ★</span><span class="visually-hidden"> champion</span></span>`}</th>
          ${contestants.map((other, column) => html`<${Cell} league=${league} relation=${relation} row=${ref} column=${other} score=${row === column ? null : scores[row][column]} games=${games[row][column]} />`)}
        </tr>`)}</tbody>
      </table>
    </div>
    <p class="key" aria-hidden="true"><span>always loses</span>${Array.from({ length: SHADES }, (_, shade) => html`<i class="h${shade}"></i>`)}<span>always wins</span></p>`;
}

function Cell({ league, relation, row, column, score, games }) {
  if (score == null) return html`<td class="none">${row === column ? "" : html`<span class="visually-hidden">no games</span>`}</td>`;
  const value = Math.round(100 * score);
  const label = `${row} scores ${value} % ${relation} ${column} in ${plural(games, "game")}`;
  return html`<td class="h${Math.min(SHADES - 1, Math.round(score * (SHADES - 1)))}">${report ? html`<span title=${label}>${value}</span>`
    : html`<a href=${query(leaguePath(league, "matches"), { first: row, second: column })} title=${label} aria-label="${label}: show matches">${value}</a>`}</td>`;
}

/** α-Rank and Nash averaging: several contestants have a share if they beat each other in a cycle, which ratings cannot show. */
function Shares({ shares, champion }) {
  const head = [["Contestant"], ["α-Rank", "number"], ["α-Rank chart", "interval-cell", true], ["Nash", "number"], ["Nash chart", "interval-cell", true], ["Against Nash", "number"]];
  return html`<h3>α-Rank and Nash averaging</h3>
    <p class="muted">Shares of the ${shares.length} contestants that have all met each other, with 95 % intervals. Several contestants have a share if they beat each other in a cycle, which ratings cannot show.
      α-Rank is the share of time in a population in which the more successful contestants are imitated; Nash is the probability in an equilibrium. <em>Against Nash</em> is the
      result of a contestant against this equilibrium, from −1 to 1, where 0 is even.</p>
    <${Table} caption="α-Rank and Nash averaging" head=${head}>
      ${shares.map(({ ref, alpha_rank: alphaRank, alpha_rank_interval: alphaBounds, nash, nash_interval: nashBounds, value }) => html`<tr key=${ref}>
        <th scope="row"><${Ref} value=${ref} champion=${champion} /></th>
        <td class="number">${rounded(alphaRank)} <small class="muted">${bounds(alphaBounds)}</small></td><td class="interval-cell"><${Bar} share=${alphaRank} interval=${alphaBounds} /></td>
        <td class="number">${rounded(nash)} <small class="muted">${bounds(nashBounds)}</small></td><td class="interval-cell"><${Bar} share=${nash} interval=${nashBounds} /></td>
        <td class="number">${signed(value, 2)}</td></tr>`)}
    <//>`;
}

const rounded = (share) => `${Math.round(100 * share)} %`; // that of α-Rank can be as small as 1e-250
const bounds = ([low, high]) => `${rounded(low)} to ${rounded(high)}`;

/** A share as a bar, with its interval as a line. */
function Bar({ share, interval: [low, high] }) {
  return html`<svg class="interval-plot" viewBox="0 0 100 16" width="100" height="16" aria-hidden="true">
    <rect width=${100 * share} y="5" height="6" /><line class="span" x1=${100 * low} x2=${100 * high} y1="8" y2="8" /></svg>`;
}
