// A game against a policy. The address holds it whole: opponent, seat, seed and the actions so far; the server, nothing.

import { html, useEffect, useState } from "./vendor/preact-htm.js";
import { ask, of } from "./api.js";
import { boardOf } from "./boards.js";
import { useData } from "./data.js";
import { useKeys } from "./keys.js";
import { Await, Badge, Empty, sentence, Trouble } from "./parts.js";
import { go, useAddress } from "./router.js";
import { Chances, did, Moves, Picture } from "./stage.js";
import { number } from "./words.js";

const SEEDS = 2 ** 31;

export function Play({ league, about }) {
  const playable = useData(of(league, "playable"));
  const game = read(useAddress().fragment);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Play</h2></div>
    <${Await} of=${playable} words="The studio lays the table …">${playable.data && (playable.data.playable
      ? game ? html`<${Table} key=${`${game.agent} ${game.seed}`} league=${league} about=${about} seats=${playable.data.agents} game=${game} />`
        : html`<${Choose} league=${league} about=${about} table=${playable.data} />`
      : html`<${Empty}>This league cannot be played here: ${sentence(playable.data.why)}<//>`)}<//>
  </section>`;
}

/** The game that a fragment holds, or null. */
function read(fragment) {
  const held = new URLSearchParams(fragment);
  if (!held.get("opponent") || !held.get("agent")) return null;
  return {
    opponent: held.get("opponent"),
    agent: held.get("agent"),
    seed: Number(held.get("seed")) || 0,
    actions: (held.get("actions") ?? "").split(",").filter(Boolean).map(Number),
  };
}

const write = (game) => `#${new URLSearchParams({ opponent: game.opponent, agent: game.agent, seed: game.seed, actions: game.actions.join(",") })}`;

const anySeed = () => crypto.getRandomValues(new Uint32Array(1))[0] % SEEDS;

function Choose({ league, about, table }) {
  const begin = (event) => {
    event.preventDefault();
    const fields = new FormData(event.target);
    const seed = fields.get("seed") ? Number(fields.get("seed")) : anySeed();
    go(write({ opponent: fields.get("opponent"), agent: fields.get("agent"), seed, actions: [] }));
  };
  return html`<form class="narrow" onSubmit=${begin}>
    <p class="soft">You take one seat; a policy plays the others, as well as it can.</p>
    <label class="field">Against <select name="opponent">
      ${about.champion != null && html`<option value="${league}@champion">${league}@champion (version ${about.champion})</option>`}
      ${table.opponents.map((ref) => html`<option value=${ref}>${ref}</option>`)}
    </select></label>
    <label class="field">Your seat <select name="agent">${table.agents.map(({ agent, side }) => html`<option value=${agent}>${agent}${side && side !== agent ? ` (${side})` : ""}</option>`)}</select></label>
    <label class="field">Seed <input name="seed" type="number" min="0" max=${SEEDS - 1} placeholder="any" /></label>
    <div class="buttons"><button type="submit" class="primary">Begin</button></div>
  </form>`;
}

function Table({ league, about, seats, game }) {
  const [wantsChances, setWantsChances] = useState(false);
  const [state, setState] = useState(null);
  const [fault, setFault] = useState(null);
  const [busy, setBusy] = useState(true);
  const [round, setRound] = useState(0);
  const { opponent, agent, seed, actions } = game;
  const told = `${actions.join()} ${wantsChances} ${round}`;
  useEffect(() => {
    const closed = new AbortController();
    setBusy(true);
    ask(of(league, "play"), { method: "POST", body: { opponent, agent, seed, actions, chances: wantsChances }, signal: closed.signal, repeatable: true }).then(
      (found) => { if (!closed.signal.aborted) { setState(found); setFault(null); setBusy(false); if (found.opponent !== opponent) go(write({ ...game, opponent: found.opponent }), { replace: true }); } },
      (error) => { if (!closed.signal.aborted) { setFault(error); setBusy(false); } },
    );
    return () => closed.abort();
  }, [told]);
  const isTurn = state && !state.over && !busy;
  const act = (action) => {
    const isLegal = isTurn && state.legal.includes(action);
    if (isLegal) go(write({ ...game, actions: [...actions, action] }), { replace: true });
    return isLegal;
  };
  const again = () => go(write({ ...game, seed: anySeed(), actions: [] }));
  const back = () => go(write({ ...game, actions: actions.slice(0, -1) }), { replace: true });
  const seat = seats.find((each) => each.agent === agent);
  return html`<div class="player">
    <div class="screen">
      <p class="turn" role="status">${said(state, busy, fault, agent)}</p>
      ${state && html`<${Board} state=${state} about=${about} act=${act} isTurn=${isTurn} />`}
      ${state && seat && !state.over && html`<${Actions} seat=${seat} legal=${state.legal} act=${act} isTurn=${isTurn} />`}
      ${fault && html`<${Trouble} fault=${fault} again=${() => setRound(round + 1)} />`}
    </div>
    <div class="told">
      <p>You are <strong>${agent}</strong> against <strong class="ref">${opponent}</strong> <${Badge}>seed ${seed}<//></p>
      <label class="option"><input type="checkbox" checked=${wantsChances} onChange=${(event) => setWantsChances(event.target.checked)} /><span>Show the policy's probabilities</span></label>
      ${wantsChances && state?.chances?.length > 0 && !state.over && html`<h3>What it would play here</h3><${Chances} of=${state.chances} />`}
      ${state && html`<${Story} steps=${state.steps} wantsChances=${wantsChances} />`}
      <div class="buttons">
        <button type="button" class=${state?.over ? "primary" : ""} onClick=${again}>Play again</button>
        <button type="button" onClick=${back} disabled=${!actions.length || busy}>Take back</button>
        <button type="button" onClick=${() => go("#")}>Other opponent</button>
      </div>
    </div>
  </div>`;
}

function said(state, busy, fault, agent) {
  if (fault) return "";
  if (!state) return "Loading …";
  if (state.over) return `${outcome(state, agent)} Your return is ${number(state.returns?.[agent] ?? 0, 2)}.`;
  return busy ? "The policy thinks …" : "Your turn.";
}

/** Of a game with a score in [0, 1]; without one the return says it all. */
function outcome({ score }) {
  if (score == null) return "The game is over.";
  return score > 0.5 ? "You have won." : score < 0.5 ? "You have lost." : "A draw.";
}

function Board({ state, about, act, isTurn }) {
  const board = boardOf(about.environment);
  const last = state.steps.at(-1);
  return html`<${Picture} src=${state.picture} words="The game after ${did(last)}">
    ${board && state.picture && !state.over && html`<div class="places x${board.columns}" aria-hidden="true">${board.places.map((action) => html`
      <button type="button" tabindex="-1" key=${action} disabled=${!isTurn || !state.legal.includes(action)} onClick=${() => act(action)} data-action=${action}></button>`)}</div>`}
  <//>`;
}

/** Every action as a button; digits press the first ten. What is not legal now is not to be pressed. */
function Actions({ seat, legal, act, isTurn }) {
  const all = Array.from({ length: seat.actions }, (_, place) => seat.start + place);
  useKeys((pressed) => /^\d$/.test(pressed) && act(Number(pressed)));
  return html`<div class="actions-grid x${all.length <= 10 ? all.length : "many"}" role="group" aria-label="Your actions">${all.map((action) => html`
    <button type="button" key=${action} aria-disabled=${!isTurn || !legal.includes(action)} class=${legal.includes(action) ? "" : "illegal"} onClick=${() => act(action)}>
      ${action}</button>`)}</div>
    ${all.length <= 10 && html`<p class="soft small keys">Keys: <kbd>${all[0]}</kbd> to <kbd>${all.at(-1)}</kbd>. On a board, click where you play.</p>`}`;
}

function Story({ steps, wantsChances }) {
  const done = steps.filter((step) => step.moves.length);
  return html`<details open class="story"><summary>Moves</summary><ol reversed class="tall" tabindex="0">${[...done].reverse().map((step) => html`<li key=${step.step} value=${step.step}>
    ${wantsChances && step.moves.some((move) => move.chances?.length) ? html`<${Moves} of=${step} />` : did(step)}</li>`)}</ol></details>`;
}
