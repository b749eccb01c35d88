// The versions of a league, with their ratings and notes.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { Chart } from "./chart.js";
import { useChangeToken, useData, useList, useMissingScope } from "./data.js";
import { EditNote, Note } from "./note.js";
import { Await, Badge, EmptyState, Ref, ShowMore, Table, Time } from "./components.js";
import { canBePromoted, Promote } from "./promotion.js";
import { Live } from "./report.js";
import { count, interval, mixture, plural, searched, short, signed } from "./format.js";

export function Versions({ league, about }) {
  const [promoting, setPromoting] = useState(null);
  const [editing, setEditing] = useState(null);
  const disabledReason = useMissingScope("promote", league);
  const token = useChangeToken("computed_at", "aliases", "version", "note");
  const ratings = useData(apiPath(league, "ratings"), token);
  const versions = useList(apiPath(league, "versions"), "versions", token);
  const rated = ratings.data?.versions ?? [];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Versions</h2></div>
    ${rated.some((each) => each.rating != null) && html`<${RatingChart} versions=${rated} />`}
    <${Await} result=${versions}>${versions.items && html`<${List} league=${league} versions=${versions.items}
      rated=${new Map(rated.map((each) => [each.number, each]))} champion=${about.champion} promote=${setPromoting} edit=${setEditing} disabledReason=${disabledReason} />`}<//>
    <${ShowMore} list=${versions} />
    ${promoting != null && html`<${Promote} league=${league} champion=${about.champion} version=${promoting} onClose=${() => setPromoting(null)} />`}
    ${editing && html`<${EditNote} league=${league} version=${editing.version} note=${editing.note} onClose=${() => setEditing(null)} />`}
  </section>`;
}

function RatingChart({ versions }) {
  const rated = versions.filter((each) => each.rating != null);
  const champions = rated.filter((each) => each.champion_at.length);
  const best = rated.reduce((one, other) => (other.rating > one.rating ? other : one));
  const label = `Ratings of ${plural(rated.length, "version")}, from ${signed(rated[0].rating)} to ${signed(rated.at(-1).rating)} Elo. Best version: `
    + `${best.ref} with ${signed(best.rating)}. Champions: ${champions.map((each) => each.ref).join(", ") || "none"}. The table below lists all values.`;
  return html`<${Chart} label=${label} xName="version" yName="Elo" height=${300} format=${(value) => signed(value)}
      x=${rated.map((each) => each.number)} lines=${[{ name: "rating", values: rated.map((each) => each.rating), dots: rated.length < 80 }]}
      intervals=${rated.map((each) => each.interval)} markers=${rated.map((each) => each.champion_at.length > 0)} />
    <p class="muted small">Bars show 95 % intervals. ◆ marks versions that became champion.</p>`;
}

function List({ league, versions, rated, champion, promote, edit, disabledReason }) {
  if (!versions.length) return html`<${EmptyState}>No versions yet.<//>`;
  const head = [["Version"], ["Rating", "number"], ["95 % interval"], ["Games", "number"], ["Algorithm"], ["Steps", "number"], ["Parent"], ["Created"], ["Note"], ["Promote", "", true]];
  return html`<${Table} caption="Versions, newest first" head=${head} cls="full">
    ${versions.map((each) => html`<${Row} key=${each.version} league=${league} version=${each} rated=${rated.get(each.version)} champion=${champion} promote=${promote} edit=${edit} disabledReason=${disabledReason} />`)}
  <//>`;
}

function Row({ league, version: each, rated, champion, promote, edit, disabledReason }) {
  const others = each.aliases.filter((alias) => alias !== "champion");
  return html`<tr class=${each.version === champion ? "champion-row" : ""}>
    <th scope="row"><${Ref} value="${league}@${each.version}" champion=${champion} />${others.map((alias) => html` <${Badge}>${alias}<//>`)}
      ${each.exploits && html` <${Badge}>exploiter of ${each.exploits}<//>`}
      ${each.retired_at && html` <${Badge}>retired<//>`}
      ${each.search && html` <span class="muted small">search with ${searched(each.search)}</span>`}
      ${each.members && html` <span class="muted small">${mixture(each.members)}</span>`}</th>
    <td class="number strong">${signed(rated?.rating)}</td>
    <td class="nowrap muted">${interval(rated?.interval)}</td>
    <td class="number">${count(rated?.games)}</td>
    <td>${each.algorithm}</td>
    <td class="number">${short(each.steps)}</td>
    <td>${each.parent == null ? html`<span class="muted">–</span>` : `@${each.parent}`}</td>
    <td class="nowrap"><${Time} at=${each.created_at} /></td>
    <td class="wrap"><${Note} note=${each.note} name="${league}@${each.version}" edit=${() => edit(each)} disabledReason=${disabledReason} /></td>
    <td>${each.version !== champion && canBePromoted(each) && html`<${Live}><button type="button" class="small" onClick=${() => promote(each.version)} disabled=${disabledReason} title=${disabledReason}
      aria-label="Promote ${league}@${each.version}">Promote …</button><//>`}</td>
  </tr>`;
}
