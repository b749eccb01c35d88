// A moment of a game: its picture, and what was done with what probability.

import { html } from "./vendor/preact-htm.js";
import { percent, tail } from "./words.js";

/** Who plays where you do. */
const PERSON = "person";

/** `words`: what the picture shows, for who does not see it. */
export function Picture({ src, words, children }) {
  return html`<div class="picture">${src
    ? html`<img src=${src} alt=${words} />`
    : html`<p class="blank soft">No picture: this environment draws none.</p>`}${children}</div>`;
}

/** What was done at a step, in words. */
export function did(step) {
  if (!step) return "";
  if (!step.moves.length) return step.step === 0 ? "The game begins." : "Nothing was done.";
  return step.moves.map((move) => `${move.agent} plays ${move.action}`).join("; ") + (step.opening ? " (random opening)" : "");
}

/** The moves of one step, each with how likely it was. */
export function Moves({ of: step }) {
  if (!step?.moves.length) return html`<p class="soft">${did(step)}</p>`;
  return html`<ul class="moves">${step.moves.map((move) => html`<li key=${move.agent}>
    <p><strong>${move.agent}</strong> <span class="soft ref">${move.ref === PERSON ? "you" : tail(move.ref)}</span> plays <strong>${String(move.action)}</strong>${step.opening && html`<span class="soft"> · random opening</span>`}</p>
    ${move.chances?.length > 0 && html`<${Chances} of=${move.chances} taken=${move.action} />`}</li>`)}</ul>`;
}

/** Probabilities of actions: bars with their numbers. */
export function Chances({ of: chances, taken, label = "Probabilities" }) {
  return html`<ul class="chances" aria-label=${label}>${chances.map(([action, share]) => html`
    <li class=${String(action) === String(taken) ? "taken" : ""}><span class="action">${String(action)}</span>
      <progress max="1" value=${share} aria-hidden="true"></progress><span class="value">${percent(share, share < 0.1 ? 1 : 0)}</span></li>`)}</ul>`;
}
