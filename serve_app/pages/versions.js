// Versions on their way: how strong each is, which ones became champion, and what they were made by.

import { html, useState } from "./vendor/preact-htm.js";
import { of } from "./api.js";
import { Chart } from "./chart.js";
import { useData, useList, useMark, useRefusal } from "./data.js";
import { Note, WriteNote } from "./note.js";
import { Await, Badge, Empty, More, Ref, Table, When } from "./parts.js";
import { Promote } from "./promoting.js";
import { count, interval, several, short, signed } from "./words.js";

export function Versions({ league, about }) {
  const [promoted, setPromoted] = useState(null);
  const [noted, setNoted] = useState(null);
  const refusal = useRefusal("promote", league);
  const mark = useMark("computed_at", "aliases", "version", "note");
  const ratings = useData(of(league, "ratings"), mark);
  const versions = useList(of(league, "versions"), "versions", mark);
  const rated = ratings.data?.versions ?? [];
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Versions</h2></div>
    ${rated.some((each) => each.rating != null) && html`<${Way} of=${rated} />`}
    <${Await} of=${versions}>${versions.items && html`<${List} league=${league} versions=${versions.items}
      rated=${new Map(rated.map((each) => [each.number, each]))} champion=${about.champion} promote=${setPromoted} write=${setNoted} refusal=${refusal} />`}<//>
    <${More} of=${versions} />
    ${promoted != null && html`<${Promote} league=${league} champion=${about.champion} version=${promoted} onClose=${() => setPromoted(null)} />`}
    ${noted && html`<${WriteNote} league=${league} version=${noted.version} note=${noted.note} onClose=${() => setNoted(null)} />`}
  </section>`;
}

function Way({ of: all }) {
  const rated = all.filter((each) => each.rating != null);
  const champions = rated.filter((each) => each.champion_at.length);
  const best = rated.reduce((one, other) => (other.rating > one.rating ? other : one));
  const label = `Ratings of ${several(rated.length, "version")}, from ${signed(rated[0].rating)} to ${signed(rated.at(-1).rating)} Elo; the best is `
    + `${best.ref} with ${signed(best.rating)}. Champions were ${champions.map((each) => each.ref).join(", ") || "none of them"}. The table below has the numbers.`;
  return html`<${Chart} label=${label} xName="version" yName="Elo" height=${300} words=${(value) => signed(value)}
      x=${rated.map((each) => each.number)} lines=${[{ name: "rating", values: rated.map((each) => each.rating), dots: rated.length < 80 }]}
      spans=${rated.map((each) => each.interval)} stars=${rated.map((each) => each.champion_at.length > 0)} />
    <p class="soft small">Bars are 95 % intervals; a filled ◆ became champion.</p>`;
}

function List({ league, versions, rated, champion, promote, write, refusal }) {
  if (!versions.length) return html`<${Empty}>No version is published yet.<//>`;
  const head = [["Version"], ["Rating", "number"], ["95 % interval"], ["Games", "number"], ["Made by"], ["Steps", "number"], ["From"], ["Made"], ["Note"], ["Promote", "", true]];
  return html`<${Table} caption="Versions, newest first" head=${head} cls="full">
    ${versions.map((each) => html`<${Row} key=${each.version} league=${league} of=${each} rated=${rated.get(each.version)} champion=${champion} promote=${promote} write=${write} refusal=${refusal} />`)}
  <//>`;
}

function Row({ league, of: each, rated, champion, promote, write, refusal }) {
  const others = each.aliases.filter((alias) => alias !== "champion");
  return html`<tr class=${each.version === champion ? "leads" : ""}>
    <th scope="row"><${Ref} of="${league}@${each.version}" champion=${champion} />${others.map((alias) => html` <${Badge}>${alias}<//>`)}</th>
    <td class="number strong">${signed(rated?.rating)}</td>
    <td class="nowrap soft">${interval(rated?.interval)}</td>
    <td class="number">${count(rated?.games)}</td>
    <td>${each.algorithm}</td>
    <td class="number">${short(each.steps)}</td>
    <td>${each.parent == null ? html`<span class="soft">–</span>` : `@${each.parent}`}</td>
    <td class="nowrap"><${When} at=${each.created_at} /></td>
    <td class="words"><${Note} of=${each.note} name="${league}@${each.version}" write=${() => write(each)} refusal=${refusal} /></td>
    <td>${each.version !== champion && html`<button type="button" class="small" onClick=${() => promote(each.version)} disabled=${refusal} title=${refusal}
      aria-label="Promote ${league}@${each.version}">Promote …</button>`}</td>
  </tr>`;
}
