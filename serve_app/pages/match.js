// One match and its games.

import { html } from "./vendor/preact-htm.js";
import { apiPath, query } from "./api.js";
import { hasOneSide, useData } from "./data.js";
import { Await, leaguePath, Properties, Table, Time, useTitle } from "./components.js";
import { count, number, shortRef } from "./format.js";

export function Match({ league, schedule, position, about }) {
  const match = useData(apiPath(league, "matches", schedule, position));
  const found = match.data;
  useTitle(found && found.contestants.map(shortRef).join(hasOneSide(about) ? " and " : " against "), league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs">${found && html`<a href=${query(leaguePath(league, "matches"), { first: found.contestants[0], second: found.contestants[1] })}>Matches of this pair</a>`}</p>
    <${Await} result=${match}>${found && html`
      <div class="head"><h2 id="heading">${found.contestants.map((ref, index) => html`${index > 0 && " · "}<span class="ref">${ref}</span>`)}</h2></div>
      <${Properties} items=${[
        ["Scores", found.scores.map((score) => number(score, 1)).join(" : ")],
        ["Kind", found.kind],
        ["Played", html`<${Time} at=${found.played_at} date />`],
        ["Schedule", html`<code>${schedule}</code> <small>#${position}</small>`, "name"],
      ]} />
      <${Games} league=${league} match=${found} schedule=${schedule} position=${position} />`}<//>
  </section>`;
}

function Games({ league, match, schedule, position }) {
  const sides = Object.keys(match.games[0]?.sides ?? {});
  return html`<${Table} caption="Games" head=${[["Game"], ...sides.map((side) => [side]), ["Scores"], ["Returns"], ["Actions", "number"], ["Forfeits"]]} cls="full">
    ${match.games.map((game) => html`<tr key=${game.game}>
      <th scope="row"><a href=${leaguePath(league, "matches", schedule, position, game.game)}>Game ${game.game}</a></th>
      ${sides.map((side) => html`<td><span class="ref">${shortRef(game.sides[side])}</span>${game.members[game.sides[side]] && html` <span class="muted">(${shortRef(game.members[game.sides[side]])})</span>`}</td>`)}
      <td class="nowrap">${numbers(game.scores)}</td><td class="nowrap">${numbers(game.returns)}</td><td class="number">${count(game.actions)}</td>
      <td class="wrap">${game.forfeits.map((each) => `${shortRef(each.ref)}: ${each.reason}`).join("; ") || html`<span class="muted">–</span>`}</td></tr>`)}
  <//>`;
}

const numbers = (values) => values?.map((value) => number(value, 1)).join(" : ") || "–";
