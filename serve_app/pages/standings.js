// Who stands where, best first, with intervals; and the same on each side, where sides are unlike.

import { html } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { useMark, useOffsets } from "./data.js";
import { Await, Empty, league as at, More, Ref, Table } from "./parts.js";
import { useAddress } from "./router.js";
import { count, interval, number, percent, several, signed } from "./words.js";

export function Standings({ league, about }) {
  const side = useAddress().parameters.get("side");
  const found = useOffsets(query(of(league, "standings"), { side }), "standings", useMark("computed_at", "aliases"));
  const sides = found.page?.sides ?? [];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Standings</h2>
      ${sides.length > 1 && html`<nav class="choice" aria-label="Sides"><ul>
        <li><a href=${at(league)} aria-current=${side ? null : "true"}>All sides</a></li>
        ${sides.map((each) => html`<li><a href=${query(at(league), { side: each })} aria-current=${each === side ? "true" : null}>${each}</a></li>`)}
      </ul></nav>`}
    </div>
    <${Await} of=${found}>${found.items && html`<${Board} league=${league} rows=${found.items} champion=${about.champion} computed=${found.page.computed_at} />`}<//>
    <${More} of=${found} />
    ${found.items?.length > 0 && html`<p class="soft small">${several(found.page.total, "contestant")}. Ratings are Elo above <code>script:random</code>, with 95 % intervals.</p>`}
  </section>`;
}

function Board({ league, rows, champion, computed }) {
  if (!rows.length) {
    return html`<${Empty}>${computed
      ? html`Nobody has played yet. <a href=${at(league, "evaluations", "new")}>Start an evaluation</a>, and it stands here.`
      : "Standings are not computed yet: the studio of a server does that, some seconds after games were played."}<//>`;
  }
  const hasReturn = rows.some((row) => row.mean_return != null);
  const span = reach(rows);
  const head = [["Rank", "number"], ["Contestant"], ["Rating", "number"], ["95 % interval"], ["Where that is", "whisker", true],
    ["Score", "number"], hasReturn && ["Mean return", "number"], ["Games", "number"]].filter(Boolean);
  return html`<${Table} caption="Standings" head=${head} cls="full standings">
    ${rows.map((row, place) => html`<tr key=${row.ref} class=${row.ref === `${league}@${champion}` ? "leads" : ""}>
      <td class="number soft">${row.rank ?? place + 1}</td>
      <th scope="row"><${Ref} of=${row.ref} champion=${champion} /></th>
      <td class="number strong">${signed(row.rating)}</td>
      <td class="nowrap soft">${interval(row.interval)}</td>
      <td class="whisker"><${Whisker} of=${row} span=${span} /></td>
      <td class="number">${percent(row.score)}</td>
      ${hasReturn && html`<td class="number">${number(row.mean_return)}</td>`}
      <td class="number">${count(row.games)}</td>
    </tr>`)}
  <//>`;
}

function reach(rows) {
  const ends = rows.filter((row) => row.rating != null).flatMap((row) => [row.rating, ...(row.interval ?? [])]).filter((end) => end != null);
  return [Math.min(0, ...ends), Math.max(1, ...ends)];
}

/** A rating and its interval on a line that all rows share; the numbers stand beside it. */
function Whisker({ of: row, span: [low, high] }) {
  if (row.rating == null) return null;
  const x = (value) => 4 + (152 * (value - low)) / (high - low);
  return html`<svg class="whiskers" viewBox="0 0 160 16" width="160" height="16" aria-hidden="true">
    <line class="zero" x1=${x(0)} x2=${x(0)} y1="0" y2="16" />
    ${row.interval && html`<line class="reach" x1=${x(row.interval[0])} x2=${x(row.interval[1])} y1="8" y2="8" />`}
    <circle cx=${x(row.rating)} cy="8" r="3.5" />
  </svg>`;
}
