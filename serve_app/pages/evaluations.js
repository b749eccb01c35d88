// Evaluations of a league, and the form that starts one.

import { html, useState } from "./vendor/preact-htm.js";
import { ask, of } from "./api.js";
import { useData, useList, useMark, useRefusal } from "./data.js";
import { Await, Empty, Form, league as at, More, Progress, State, Table, useTitle, When } from "./parts.js";
import { go } from "./router.js";
import { tail } from "./words.js";

export function Evaluations({ league }) {
  const evaluations = useList(of(league, "evaluations"), "evaluations", useMark("evaluation", "evaluations"));
  const refusal = useRefusal("evaluate", league);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Evaluations</h2>${refusal ? html`<p class="soft">${refusal}</p>`
      : html`<a class="button primary" href=${at(league, "evaluations", "new")}>Start one …</a>`}</div>
    <${Await} of=${evaluations}>${evaluations.items && (evaluations.items.length
      ? html`<${Table} caption="Evaluations, newest first" head=${[["Evaluation"], ["State"], ["What"], ["How far"], ["By"], ["Reason"], ["Asked"]]} cls="full">
          ${evaluations.items.map((each) => html`<${Row} key=${each.evaluation} league=${league} of=${each} />`)}<//>`
      : html`<${Empty}>None was asked for yet. An evaluation plays games between versions, beside what is served.<//>`)}<//>
    <${More} of=${evaluations} />
  </section>`;
}

function Row({ league, of: each }) {
  const { progress } = each;
  return html`<tr>
    <th scope="row"><a href=${at(league, "evaluations", each.evaluation)}>#${each.evaluation}</a></th>
    <td><${State} of=${each.state} /></td>
    <td>${called(each.asked)}</td>
    <td>${progress ? html`<${Progress} played=${progress.played} of=${progress.of} what="Progress of evaluation ${each.evaluation}" />` : html`<span class="soft">–</span>`}</td>
    <td class="words">${each.actor}</td><td class="words">${each.reason ?? html`<span class="soft">–</span>`}</td>
    <td class="nowrap"><${When} at=${each.created_at} /></td>
  </tr>`;
}

/** What was asked for, in words. */
export function called(asked) {
  if (asked.kind === "nightly") return "night";
  const names = { round_robin: "round robin", gauntlet: "gauntlet", adaptive: "adaptive tournament", cross_play: "cross-play" };
  return `${names[asked.schedule] ?? asked.schedule}, ${asked.contestants.length} contestants`;
}

const SCHEDULES = [
  ["round_robin", "Round robin: everybody meets everybody"],
  ["gauntlet", "Gauntlet: each meets the champion and the baselines"],
  ["adaptive", "Adaptive: plays where a match tells most"],
  ["cross_play", "Cross-play: strangers in one team"],
];

export function NewEvaluation({ league, about }) {
  const [kind, setKind] = useState("tournament");
  useTitle("Start an evaluation", league);
  const submit = async (fields) => {
    const started = await ask(of(league, "evaluations"), { method: "POST", body: asked(fields) });
    go(at(league, "evaluations", started.evaluation));
  };
  return html`<section aria-labelledby="heading" class="narrow">
    <p class="crumbs"><a href=${at(league, "evaluations")}>Evaluations</a></p>
    <div class="head"><h2 id="heading">Start an evaluation</h2></div>
    <${Form} submit=${submit} label="Start">
      <fieldset><legend>Kind</legend>
        <label class="option"><input type="radio" name="kind" value="tournament" checked=${kind === "tournament"} onChange=${() => setKind("tournament")} />
          <span>Tournament<small>Games for ratings. Nothing is promoted.</small></span></label>
        <label class="option"><input type="radio" name="kind" value="nightly" checked=${kind === "nightly"} onChange=${() => setKind("nightly")} />
          <span>Night<small>New versions are judged, the best is promoted, everybody is rated. The key needs the scope <code>promote</code>.</small></span></label>
      </fieldset>
      ${kind === "tournament" && html`<${Tournament} league=${league} champion=${about.champion} />`}
      <label class="field">Reason <input name="reason" maxlength="2000" placeholder="optional, kept beside it" /></label>
    <//>
  </section>`;
}

function Tournament({ league, champion }) {
  const [schedule, setSchedule] = useState("round_robin");
  const versions = useData(of(league, "versions"));
  const refs = versions.data && ["script:random", "script:one_ply", ...versions.data.versions.map((each) => `${league}@${each.version}`).reverse()];
  return html`
    <label class="field">Schedule <select name="schedule" value=${schedule} onChange=${(event) => setSchedule(event.target.value)}>
      ${SCHEDULES.map(([name, words]) => html`<option value=${name}>${words}</option>`)}</select></label>
    <${Await} of=${versions}>${refs && html`
      <${Choice} name="contestants" legend="Contestants" none="every version" refs=${refs} champion=${champion} />
      ${schedule === "gauntlet" && html`<${Choice} name="against" legend="Against" none="the champion and the baselines" refs=${refs} champion=${champion} />`}`}<//>
    <fieldset class="budget"><legend>How much</legend>
      <label class="field">Blocks of each pair <input name="blocks" type="number" min="1" max="100000" placeholder="32" /></label>
      <label class="field">At most games <input name="games" type="number" min="2" placeholder="no limit" /></label>
      <label class="field">At most minutes <input name="minutes" type="number" min="0.1" step="any" placeholder="no limit" /></label>
      ${schedule !== "cross_play" && html`<label class="field">Until ± Elo <input name="precision" type="number" min="1" step="any" placeholder="not asked" /></label>`}
      <label class="field">Seed <input name="seed" type="number" min="0" placeholder="0" /></label>
    </fieldset>`;
}

/** Versions and scripts, of which none means the default. */
function Choice({ name, legend, none, refs, champion }) {
  const [chosen, setChosen] = useState(new Set());
  const [sought, setSought] = useState("");
  const toggle = (ref) => setChosen((was) => { const now = new Set(was); if (!now.delete(ref)) now.add(ref); return now; });
  return html`<fieldset><legend>${legend}: ${chosen.size ? `${chosen.size} chosen` : none}</legend>
    ${refs.length > 12 && html`<input type="search" aria-label="Find among ${legend.toLowerCase()}" placeholder="Find" value=${sought} onInput=${(event) => setSought(event.target.value)} />`}
    <div class="refs" tabindex=${refs.length > 12 ? 0 : null} role="group" aria-label=${legend}>${refs.map((ref) => html`
      <label key=${ref} class="pick" hidden=${!ref.includes(sought.trim())}><input type="checkbox" name=${name} value=${ref} checked=${chosen.has(ref)} onChange=${() => toggle(ref)} />
        <span class="ref">${tail(ref)}</span>${ref.endsWith(`@${champion}`) && html`<span aria-hidden="true"> ★</span><span class="unseen"> champion</span>`}</label>`)}</div>
  </fieldset>`;
}

/** The form as the body of the request: what is empty is left out. */
function asked(fields) {
  const kind = fields.get("kind");
  const reason = fields.get("reason").trim();
  const body = { kind, ...(reason && { reason }) };
  if (kind === "nightly") return body;
  const numbers = ["blocks", "games", "minutes", "precision", "seed"].map((name) => [name, fields.get(name)]).filter(([, text]) => text);
  const lists = ["contestants", "against"].map((name) => [name, fields.getAll(name)]).filter(([, refs]) => refs.length);
  return { ...body, schedule: fields.get("schedule"), ...Object.fromEntries(lists), ...Object.fromEntries(numbers.map(([name, text]) => [name, Number(text)])) };
}
