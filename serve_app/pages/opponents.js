// The opponents that a run has drawn from its league: their shares of the episodes, and the learner's scores against them.

import { html } from "./vendor/preact-htm.js";
import { Chart, DataTable } from "./chart.js";
import { Table } from "./components.js";
import { percent, shortRef } from "./format.js";

const PREFIX = "opponents/";
const RARE = 0.0005;
const METRICS = [["share", "Share of the episodes"], ["score", "Score of the learner"]];

export const isOpponentCurve = (name) => name.startsWith(PREFIX);

/** `curves`: the latest value of each curve. `points`: their history. */
export function Opponents({ curves, points }) {
  const latest = opponentsOf(curves);
  if (!latest.length) return null;
  const x = points.map((point) => point.steps);
  return html`<section aria-labelledby="opponents">
    <h3 id="opponents">Opponents</h3>
    <${Table} caption="Opponents, the most frequent first" head=${[["Opponent"], ["Share of the episodes", "number"], ["Score of the learner", "number"]]}>
      ${latest.map(({ ref, share, score }) => html`<tr key=${ref}><th scope="row"><span class="ref">${shortRef(ref)}</span></th>
        <td class="number">${percent(share)}</td><td class="number">${percent(score)}</td></tr>`)}
    <//>
    <p class="muted small">The remaining episodes are self-play. Shares and scores are estimates from recent training games, in which a draw counts ½.</p>
    ${x.length > 0 && html`<div class="curves">${METRICS.map(([metric, name]) => html`<${MetricChart} key=${metric} metric=${metric} name=${name} x=${x}
      lines=${latest.map(({ ref }) => ({ name: shortRef(ref), values: points.map((point) => point.curves[`${PREFIX}${ref}/${metric}`] ?? null) }))} />`)}</div>`}
  </section>`;
}

function MetricChart({ metric, name, x, lines }) {
  return html`<article><h4>${name}</h4>
    <${Chart} label="${name} of ${lines.length} opponents. The table above lists the latest values." x=${x} lines=${lines} xName="steps" yName=${metric} height=${220} format=${(share) => percent(share)} />
    <${DataTable} x=${x} lines=${lines} xName="steps" caption=${name} format=${(share) => percent(share)} /></article>`;
}

/** [{ref, share, score}] of recent episodes, the most frequent first. */
function opponentsOf(curves) {
  const found = new Map();
  for (const [name, value] of Object.entries(curves)) {
    if (!isOpponentCurve(name)) continue;
    const end = name.lastIndexOf("/");
    const ref = name.slice(PREFIX.length, end);
    found.set(ref, { ref, ...found.get(ref), [name.slice(end + 1)]: value });
  }
  // Opponents that are no longer drawn have a share that approaches 0.
  return [...found.values()].filter(({ share }) => (share ?? 0) >= RARE).sort((one, other) => (other.share ?? 0) - (one.share ?? 0));
}
