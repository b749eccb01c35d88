// Which version was champion when, since when, by whom and why.

import { html, useState } from "./vendor/preact-htm.js";
import { of, query } from "./api.js";
import { useData, useList, useMark } from "./data.js";
import { Await, Empty, league as at, More, Table, When } from "./parts.js";
import { moment } from "./words.js";

export function History({ league, about }) {
  const aliases = [...new Set(["champion", ...Object.keys(about.aliases ?? {})])];
  const [alias, setAlias] = useState("champion");
  const events = useList(of(league, "aliases", alias, "history"), "history", useMark("event"));
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">History</h2>
      ${aliases.length > 1 && html`<label class="inline">of <select value=${alias} onChange=${(event) => setAlias(event.target.value)}>
        ${aliases.map((each) => html`<option value=${each}>${each}</option>`)}</select></label>`}
    </div>
    <${Then} league=${league} alias=${alias} />
    <${Await} of=${events}>${events.items && (events.items.length
      ? html`<${Table} caption="What ${alias} was, newest first" head=${[["When"], ["Version"], ["Before"], ["How"], ["By"], ["Reason"]]} cls="full">
          ${events.items.map((each) => html`<${Row} key=${each.event} league=${league} of=${each} />`)}<//>`
      : html`<${Empty}>No version has been ${alias} yet.<//>`)}<//>
    <${More} of=${events} />
  </section>`;
}

function Row({ league, of: event }) {
  const how = event.kind === "rollback" ? "rolled back" : event.verdict ? "promoted by the gate" : "by hand";
  return html`<tr>
    <td class="nowrap"><${When} at=${event.at} date /></td>
    <th scope="row"><span class="ref">@${event.version}</span></th>
    <td>${event.previous == null ? html`<span class="soft">–</span>` : html`<span class="ref">@${event.previous}</span>`}</td>
    <td class="nowrap">${event.verdict ? html`<a href=${at(league, "verdicts", event.verdict)}>${how}</a>` : how}</td>
    <td class="words">${event.actor}</td>
    <td class="words">${event.reason}</td>
  </tr>`;
}

/** Who was it then? */
function Then({ league, alias }) {
  const [asked, setAsked] = useState("");
  const instant = asked && new Date(asked);
  const isInstant = instant && !Number.isNaN(instant.getTime());
  const path = isInstant ? query(of(league, "aliases", alias, "history"), { at: instant.toISOString() }) : null;
  const found = useData(path);
  const event = found.data && found.data.history[0];
  return html`<form class="then" onSubmit=${(submitted) => submitted.preventDefault()}>
    <label class="inline">Who was ${alias} at <input type="datetime-local" value=${asked} onInput=${(typed) => setAsked(typed.target.value)} />?</label>
    <p role="status">${found.fault ? found.fault.message : found.data && (event
      ? html`At ${moment(instant)} it was <strong class="ref">${league}@${event.version}</strong>, since <${When} at=${event.at} date />.`
      : html`At ${moment(instant)} there was none.`)}</p>
  </form>`;
}
