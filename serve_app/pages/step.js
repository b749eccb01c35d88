// One step of a game: its picture, the moves, and the probabilities of the actions.

import { html } from "./vendor/preact-htm.js";
import { apiPath } from "./api.js";
import { useData } from "./data.js";
import { number, percent, searched, shortRef } from "./format.js";

/** The reference of the user in a game against a policy. */
const PERSON = "person";

/** Simulations of a search version with which the server evaluates positions, at most. */
const MOST_ANALYSED = 1000;

export function Picture({ src, alt, children }) {
  return html`<div class="picture">${src
    ? html`<img src=${src} alt=${alt} />`
    : html`<p class="blank muted">This environment does not render pictures.</p>`}${children}</div>`;
}

/** The name of an action. `names`: action → name, of one agent; without names, the action itself. */
export const actionName = (names, action) => names?.[action] ?? String(action);

/** The moves of a step as text. `names`: agent → action → name. */
export function describe(step, names) {
  if (!step) return "";
  if (!step.moves.length) return step.step === 0 ? "Start of the game." : "No moves.";
  return step.moves.map((move) => `${move.agent} plays ${actionName(names?.[move.agent], move.action)}${move.ref === PERSON ? " (you)" : ""}`).join("; ") + (step.opening ? " (random opening)" : "");
}

/** The moves of a step with their probabilities. */
export function Moves({ step, names }) {
  if (!step?.moves.length) return html`<p class="muted">${describe(step, names)}</p>`;
  return html`<ul class="moves">${step.moves.map((move) => html`<li key=${move.agent}>
    <p><strong>${move.agent}</strong> <span class="muted ref">${move.ref === PERSON ? "you" : shortRef(move.ref)}</span> plays <strong>${actionName(names?.[move.agent], move.action)}</strong>${step.opening && html`<span class="muted"> · random opening</span>`}</p>
    ${move.value != null && html`<p class="muted small">expected return ${number(move.value, 2)}</p>`}
    ${move.chances?.length > 0 && html`<${Probabilities} values=${move.chances} taken=${move.action} names=${names?.[move.agent]} />`}</li>`)}</ul>`;
}

/** Probabilities of actions, as bars with numbers. `values`: [action, probability] pairs. */
export function Probabilities({ values, taken, names }) {
  return html`<ul class="probabilities ${names && Object.keys(names).length ? "named" : ""}" aria-label="Probabilities">${values.map(([action, probability]) => html`
    <li class=${String(action) === String(taken) ? "taken" : ""}><span class="action">${actionName(names, action)}</span>
      <progress max="1" value=${probability} aria-hidden="true"></progress><span class="value">${percent(probability)}</span></li>`)}</ul>`;
}

/** A choice of a search version that evaluates positions; nothing in a league without one. `value`: its number, or null. */
export function Analyst({ league, value, onChange }) {
  const searching = useData(apiPath(league, "versions")).data?.versions.filter((version) => version.search?.simulations <= MOST_ANALYSED && !version.retired_at) ?? [];
  return searching.length > 0 && html`<label class="field">Analysis <select value=${value ?? ""} onChange=${(event) => onChange(Number(event.target.value) || null)}>
    <option value="">none</option>
    ${searching.map((version) => html`<option value=${version.version}>@${version.version}: ${searched(version.search)}</option>`)}
  </select></label>`;
}
