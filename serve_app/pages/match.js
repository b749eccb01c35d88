// One match: its games, each of which can be watched.

import { html } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { useData } from "./data.js";
import { Await, Facts, league as at, Table, useTitle, When } from "./parts.js";
import { count, number, tail } from "./words.js";

export function Match({ league, schedule, position }) {
  const match = useData(of(league, "matches", schedule, position));
  const found = match.data;
  useTitle(found && found.contestants.map(tail).join(" against "), league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs">${found && html`<a href=${query(at(league, "matches"), { first: found.contestants[0], second: found.contestants[1] })}>Their matches</a>`}</p>
    <${Await} of=${match}>${found && html`
      <div class="head"><h2 id="heading">${found.contestants.map((ref, place) => html`${place > 0 && " · "}<span class="ref">${ref}</span>`)}</h2></div>
      <${Facts} of=${[
        ["Scores", found.scores.map((score) => number(score, 1)).join(" : ")],
        ["Kind", found.kind],
        ["Played", html`<${When} at=${found.played_at} date />`],
        ["Schedule", html`<code>${schedule}</code> <small>#${position}</small>`, "name"],
      ]} />
      <${Games} league=${league} of=${found} schedule=${schedule} position=${position} />`}<//>
  </section>`;
}

function Games({ league, of: match, schedule, position }) {
  const sides = Object.keys(match.games[0]?.sides ?? {});
  return html`<${Table} caption="Games" head=${[["Game"], ...sides.map((side) => [side]), ["Scores"], ["Returns"], ["Actions", "number"], ["Forfeited by"]]} cls="full">
    ${match.games.map((game) => html`<tr key=${game.game}>
      <th scope="row"><a href=${at(league, "matches", schedule, position, game.game)}>Watch ${game.game}</a></th>
      ${sides.map((side) => html`<td><span class="ref">${tail(game.sides[side])}</span></td>`)}
      <td class="nowrap">${numbers(game.scores)}</td><td class="nowrap">${numbers(game.returns)}</td><td class="number">${count(game.actions)}</td>
      <td class="words">${game.forfeits.map((each) => `${tail(each.ref)}: ${each.reason}`).join("; ") || html`<span class="soft">–</span>`}</td></tr>`)}
  <//>`;
}

const numbers = (values) => values?.map((value) => number(value, 1)).join(" : ") || "–";
