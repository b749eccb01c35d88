// The strength of a run's versions: their scores, one chart per opponent.

import { html } from "./vendor/preact-htm.js";
import { Chart } from "./chart.js";
import { Table } from "./components.js";
import { count, percent, shortRef } from "./format.js";

const EVEN = [{ name: "even", value: 0.5, tone: "muted" }];

/** `rows`: {version, steps, opponent, games, score, low, high}, oldest version first. */
export function Strength({ league, rows }) {
  if (!rows.length) return null;
  const byOpponent = Map.groupBy(rows, (row) => row.opponent);
  return html`<section aria-labelledby="strength">
    <h3 id="strength">Strength</h3>
    <p class="muted small">Mean scores of this run's versions against the opponents below, with 95 % intervals. All versions play the same openings. These games do not affect ratings or verdicts.</p>
    <div class="curves">${[...byOpponent].map(([opponent, own]) => html`<${OpponentChart} key=${opponent} opponent=${opponent} rows=${own} />`)}</div>
    <details class="numbers"><summary>Show as table</summary>
      <${Table} caption="Strength of the versions" head=${[["Version"], ["Steps", "number"], ["Opponent"], ["Score", "number"], ["95 % interval"], ["Games", "number"]]}>
        ${rows.map((row) => html`<tr key="${row.version} ${row.opponent}">
          <th scope="row"><span class="ref">${league}@${row.version}</span></th><td class="number">${count(row.steps)}</td><td><span class="ref">${shortRef(row.opponent)}</span></td>
          <td class="number strong">${percent(row.score)}</td><td class="nowrap muted">${range(row)}</td><td class="number">${count(row.games)}</td></tr>`)}
      <//>
    </details>
  </section>`;
}

function OpponentChart({ opponent, rows }) {
  const last = rows.at(-1);
  const label = `Scores against ${opponent}. Version ${last.version}: ${percent(last.score)}, 95 % interval ${range(last)}.`;
  return html`<article><h4>against ${shortRef(opponent)}</h4>
    <${Chart} label=${label} x=${rows.map((row) => row.steps)} xName="total steps" yName="score" height=${220} format=${(share) => percent(share)} thresholds=${EVEN}
      lines=${[{ name: "score", values: rows.map((row) => row.score), dots: true }]} intervals=${rows.map((row) => [row.low, row.high])} /></article>`;
}

/** The 95 % interval of a score. */
export const range = ({ low, high }) => `${percent(low)} to ${percent(high)}`;
