// The evaluations of a league, and the form to start one.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { useChangeToken, useData, useList, useMissingScope } from "./data.js";
import { Await, EmptyState, Form, leaguePath, LongText, Progress, ShowMore, State, Table, Time, useTitle } from "./components.js";
import { navigate } from "./router.js";
import { mixture, searched, shortRef } from "./format.js";

export function Evaluations({ league }) {
  const evaluations = useList(apiPath(league, "evaluations"), "evaluations", useChangeToken("evaluation", "evaluations"));
  const missingScope = useMissingScope("evaluate", league);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Evaluations</h2>${missingScope ? html`<p class="muted">${missingScope}</p>`
      : html`<a class="button primary" href=${leaguePath(league, "evaluations", "new")}>New evaluation</a>`}</div>
    <${Await} result=${evaluations}>${evaluations.items && (evaluations.items.length
      ? html`<${Table} caption="Evaluations, newest first" head=${[["Evaluation"], ["State"], ["Type"], ["Progress"], ["Started by"], ["Reason"], ["Created"]]} cls="full">
          ${evaluations.items.map((each) => html`<${Row} key=${each.evaluation} league=${league} evaluation=${each} />`)}<//>`
      : html`<${EmptyState}>No evaluations yet. An evaluation plays games between versions without affecting the served policies.<//>`)}<//>
    <${ShowMore} list=${evaluations} />
  </section>`;
}

function Row({ league, evaluation: each }) {
  const { progress } = each;
  return html`<tr>
    <th scope="row"><a href=${leaguePath(league, "evaluations", each.evaluation)}>#${each.evaluation}</a></th>
    <td><${State} value=${each.state} /></td>
    <td>${typeOf(each.request)}</td>
    <td>${progress ? html`<${Progress} played=${progress.played} of=${progress.of} label="Progress of evaluation ${each.evaluation}" />` : html`<span class="muted">–</span>`}</td>
    <td class="wrap"><${LongText}>${each.actor}<//></td><td class="wrap long"><${LongText}>${each.reason}<//></td>
    <td class="nowrap"><${Time} at=${each.created_at} /></td>
  </tr>`;
}

/** The type of an evaluation as text. */
export function typeOf(request) {
  if (request.kind === "nightly") return "nightly run";
  const names = { round_robin: "round robin", gauntlet: "gauntlet", adaptive: "adaptive tournament", cross_play: "cross-play" };
  return `${names[request.schedule] ?? request.schedule}, ${request.contestants.length} contestants`;
}

const SCHEDULES = [
  ["round_robin", "Round robin: all pairs of contestants"],
  ["gauntlet", "Gauntlet: each contestant against the champion and the baselines"],
  ["adaptive", "Adaptive: matches that reduce rating uncertainty most"],
  ["cross_play", "Cross-play: policies of different versions in one team"],
];

export function NewEvaluation({ league, about }) {
  const [kind, setKind] = useState("tournament");
  useTitle("New evaluation", league);
  const submit = async (fields) => {
    const started = await request(apiPath(league, "evaluations"), { method: "POST", body: bodyOf(fields) });
    navigate(leaguePath(league, "evaluations", started.evaluation));
  };
  return html`<section aria-labelledby="heading" class="narrow">
    <p class="crumbs"><a href=${leaguePath(league, "evaluations")}>Evaluations</a></p>
    <div class="head"><h2 id="heading">New evaluation</h2></div>
    <${Form} submit=${submit} label="Start">
      <fieldset><legend>Type</legend>
        <label class="option"><input type="radio" name="kind" value="tournament" checked=${kind === "tournament"} onChange=${() => setKind("tournament")} />
          <span>Tournament<small>Plays games to rate the contestants. Does not promote a version.</small></span></label>
        <label class="option"><input type="radio" name="kind" value="nightly" checked=${kind === "nightly"} onChange=${() => setKind("nightly")} />
          <span>Nightly run<small>Tests new versions, promotes the strongest and updates all ratings. Requires a key with the scope <code>promote</code>.</small></span></label>
      </fieldset>
      ${kind === "tournament" && html`<${Tournament} league=${league} champion=${about.champion} baselines=${about.baselines} />`}
      <label class="field">Reason <input name="reason" maxlength="2000" placeholder="optional" /></label>
    <//>
  </section>`;
}

function Tournament({ league, champion, baselines }) {
  const [schedule, setSchedule] = useState("round_robin");
  const versions = useData(apiPath(league, "versions"));
  const contestants = versions.data && [
    ...baselines.map((ref) => ({ ref })),
    ...versions.data.versions.filter((each) => !each.retired_at).map((each) => ({ ref: `${league}@${each.version}`, role: roleOf(each) })).reverse(),
  ];
  return html`
    <label class="field">Schedule <select name="schedule" value=${schedule} onChange=${(event) => setSchedule(event.target.value)}>
      ${SCHEDULES.map(([name, label]) => html`<option value=${name}>${label}</option>`)}</select></label>
    <${Await} result=${versions}>${contestants && html`
      <${Choice} name="contestants" legend="Contestants" none="all versions" choices=${contestants} champion=${champion} />
      ${schedule === "gauntlet" && html`<${Choice} name="against" legend="Against" none="the champion and the baselines" choices=${contestants} champion=${champion} />`}`}<//>
    <fieldset class="budget"><legend>Budget</legend>
      <label class="field">Blocks per pair <input name="blocks" type="number" min="1" max="100000" placeholder="32" /></label>
      <label class="field">Maximum games <input name="games" type="number" min="2" placeholder="no limit" /></label>
      <label class="field">Maximum minutes <input name="minutes" type="number" min="0.1" step="any" placeholder="no limit" /></label>
      ${schedule !== "cross_play" && html`<label class="field">Precision, ± Elo <input name="precision" type="number" min="1" step="any" placeholder="no target" /></label>`}
      <label class="field">Seed <input name="seed" type="number" min="0" placeholder="0" /></label>
    </fieldset>`;
}

/** The role of an exploiter, a search version or a mixture as text. */
function roleOf({ exploits, members, search }) {
  if (search) return `search with ${searched(search)}`;
  return exploits ? `exploiter of ${shortRef(exploits)}` : members && mixture(members);
}

/** A selection among `choices`, {ref, role}; an empty selection stands for the default, described by `none`. */
function Choice({ name, legend, none, choices, champion }) {
  const [selected, setSelected] = useState(new Set());
  const [filter, setFilter] = useState("");
  const toggle = (ref) => setSelected((previous) => { const next = new Set(previous); if (!next.delete(ref)) next.add(ref); return next; });
  return html`<fieldset><legend>${legend}: ${selected.size ? `${selected.size} selected` : none}</legend>
    ${choices.length > 12 && html`<input type="search" aria-label="Filter ${legend.toLowerCase()}" placeholder="Filter" value=${filter} onInput=${(event) => setFilter(event.target.value)} />`}
    <div class="refs" tabindex=${choices.length > 12 ? 0 : null} role="group" aria-label=${legend}>${choices.map(({ ref, role }) => html`
      <label key=${ref} class="pick" hidden=${!ref.includes(filter.trim())}><input type="checkbox" name=${name} value=${ref} checked=${selected.has(ref)} onChange=${() => toggle(ref)} />
        <span class="ref">${shortRef(ref)}</span>${role && html` <span class="muted small">${role}</span>`}${ref.endsWith(`@${champion}`) && html`<span aria-hidden="true"> ★</span><span class="visually-hidden"> champion</span>`}</label>`)}</div>
  </fieldset>`;
}

/** The request body of the form, without empty fields. */
function bodyOf(fields) {
  const kind = fields.get("kind");
  const reason = fields.get("reason").trim();
  const body = { kind, ...(reason && { reason }) };
  if (kind === "nightly") return body;
  const numbers = ["blocks", "games", "minutes", "precision", "seed"].map((name) => [name, fields.get(name)]).filter(([, text]) => text);
  const lists = ["contestants", "against"].map((name) => [name, fields.getAll(name)]).filter(([, refs]) => refs.length);
  return { ...body, schedule: fields.get("schedule"), ...Object.fromEntries(lists), ...Object.fromEntries(numbers.map(([name, text]) => [name, Number(text)])) };
}
