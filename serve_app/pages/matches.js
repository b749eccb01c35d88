// The matches of the ledger: of one pair, or all of them, newest first.

import { html } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { useList, useMark } from "./data.js";
import { Await, Badge, Empty, league as at, More, Table, useTitle, When } from "./parts.js";
import { useAddress } from "./router.js";
import { count, number, tail } from "./words.js";

export function Matches({ league }) {
  const { parameters } = useAddress();
  const [first, second] = [parameters.get("first"), parameters.get("second")];
  const matches = useList(query(of(league, "matches"), { first, second }), "matches", useMark("computed_at"));
  const isPair = first && second;
  useTitle(isPair ? `${tail(first)} against ${tail(second)}` : "Matches", league);
  return html`<section aria-labelledby="heading">
    <p class="crumbs"><a href=${at(league, "payoff")}>Who beats whom</a></p>
    <div class="head"><h2 id="heading">${isPair ? html`<span class="ref">${first}</span> against <span class="ref">${second}</span>` : "Matches"}</h2>
      ${isPair && html`<a href=${at(league, "matches")}>All matches</a>`}</div>
    <p class="soft">A match is a block of games from one opening, in which the contestants change seats.</p>
    <${Await} of=${matches}>${matches.items && (matches.items.length
      ? html`<${Table} caption="Matches, newest first" head=${[["Match"], ["Contestants"], ["Scores"], ["Games", "number"], ["Kind"], ["Played"]]} cls="full">
          ${matches.items.map((each) => html`<${Row} key=${each.match} league=${league} of=${each} />`)}<//>`
      : html`<${Empty}>${isPair ? "They have not met." : "Nothing was played yet."}<//>`)}<//>
    <${More} of=${matches} />
  </section>`;
}

function Row({ league, of: match }) {
  return html`<tr>
    <th scope="row"><a href=${at(league, "matches", match.schedule, match.position)} aria-label="Match ${match.position} of ${match.schedule}">#${match.position}</a></th>
    <td>${match.contestants.map((ref, place) => html`${place > 0 && html`<span class="soft"> · </span>`}<span class="ref">${tail(ref)}</span>`)}</td>
    <td class="nowrap">${match.scores.map((score) => number(score, 1)).join(" : ")}</td>
    <td class="number">${count(match.games)}</td>
    <td class="nowrap">${match.kind}${!match.counts && html` <${Badge} sign="∅">does not count<//>`}</td>
    <td class="nowrap"><${When} at=${match.played_at} /></td>
  </tr>`;
}
