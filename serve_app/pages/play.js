// Play against a policy. The address contains the whole game: opponent, seat, seed and actions. The server keeps no state.

import { html, useEffect, useState } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { boardOf } from "./boards.js";
import { useData } from "./data.js";
import { useKeys } from "./keyboard.js";
import { Await, Badge, EmptyState, ErrorNotice, sentence } from "./components.js";
import { navigate, useAddress } from "./router.js";
import { describe, Moves, Picture, Probabilities } from "./step.js";
import { number } from "./format.js";

const SEED_LIMIT = 2 ** 31;

export function Play({ league, about }) {
  const playable = useData(apiPath(league, "playable"));
  const game = parseGame(useAddress().fragment);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Play</h2></div>
    <${Await} result=${playable} message="Starting the evaluation service …">${playable.data && (playable.data.playable
      ? game ? html`<${Game} key=${`${game.agent} ${game.seed}`} league=${league} about=${about} seats=${playable.data.agents} game=${game} />`
        : html`<${NewGame} league=${league} about=${about} playable=${playable.data} />`
      : html`<${EmptyState}>You cannot play in this league: ${sentence(playable.data.why)}<//>`)}<//>
  </section>`;
}

/** The game in a URL fragment, or null. */
function parseGame(fragment) {
  const parameters = new URLSearchParams(fragment);
  if (!parameters.get("opponent") || !parameters.get("agent")) return null;
  return {
    opponent: parameters.get("opponent"),
    agent: parameters.get("agent"),
    seed: Number(parameters.get("seed")) || 0,
    actions: (parameters.get("actions") ?? "").split(",").filter(Boolean).map(Number),
  };
}

const fragmentOf = (game) => `#${new URLSearchParams({ opponent: game.opponent, agent: game.agent, seed: game.seed, actions: game.actions.join(",") })}`;

const randomSeed = () => crypto.getRandomValues(new Uint32Array(1))[0] % SEED_LIMIT;

function NewGame({ league, about, playable }) {
  const start = (event) => {
    event.preventDefault();
    const fields = new FormData(event.target);
    const seed = fields.get("seed") ? Number(fields.get("seed")) : randomSeed();
    navigate(fragmentOf({ opponent: fields.get("opponent"), agent: fields.get("agent"), seed, actions: [] }));
  };
  return html`<form class="narrow" onSubmit=${start}>
    <p class="muted">You play one agent. The opponent plays all others and always takes its best action.</p>
    <label class="field">Opponent <select name="opponent">
      ${about.champion != null && html`<option value="${league}@champion">${league}@champion (version ${about.champion})</option>`}
      ${playable.opponents.map((ref) => html`<option value=${ref}>${ref}</option>`)}
    </select></label>
    <label class="field">Your agent <select name="agent">${playable.agents.map(({ agent, side }) => html`<option value=${agent}>${agent}${side && side !== agent ? ` (${side})` : ""}</option>`)}</select></label>
    <label class="field">Seed <input name="seed" type="number" min="0" max=${SEED_LIMIT - 1} placeholder="random" /></label>
    <div class="buttons"><button type="submit" class="primary">Start game</button></div>
  </form>`;
}

function Game({ league, about, seats, game }) {
  const [showProbabilities, setShowProbabilities] = useState(false);
  const [state, setState] = useState(null);
  const [error, setError] = useState(null);
  const [busy, setBusy] = useState(true);
  const [attempt, setAttempt] = useState(0);
  const { opponent, agent, seed, actions } = game;
  const requestKey = `${actions.join()} ${showProbabilities} ${attempt}`;
  useEffect(() => {
    const closed = new AbortController();
    setBusy(true);
    request(apiPath(league, "play"), { method: "POST", body: { opponent, agent, seed, actions, chances: showProbabilities }, signal: closed.signal, repeatable: true }).then(
      (loaded) => { if (!closed.signal.aborted) { setState(loaded); setError(null); setBusy(false); if (loaded.opponent !== opponent) navigate(fragmentOf({ ...game, opponent: loaded.opponent }), { replace: true }); } },
      (failure) => { if (!closed.signal.aborted) { setError(failure); setBusy(false); } },
    );
    return () => closed.abort();
  }, [requestKey]);
  const isTurn = state && !state.over && !busy;
  const act = (action) => {
    const isLegal = isTurn && state.legal.includes(action);
    if (isLegal) navigate(fragmentOf({ ...game, actions: [...actions, action] }), { replace: true });
    return isLegal;
  };
  const restart = () => navigate(fragmentOf({ ...game, seed: randomSeed(), actions: [] }));
  const undo = () => navigate(fragmentOf({ ...game, actions: actions.slice(0, -1) }), { replace: true });
  const seat = seats.find((each) => each.agent === agent);
  return html`<div class="player">
    <div class="screen">
      <p class="turn" role="status">${statusOf(state, busy, error, agent)}</p>
      ${state && html`<${Board} state=${state} about=${about} act=${act} isTurn=${isTurn} />`}
      ${state && seat && !state.over && html`<${Actions} seat=${seat} legal=${state.legal} act=${act} isTurn=${isTurn} />`}
      ${error && html`<${ErrorNotice} error=${error} retry=${() => setAttempt(attempt + 1)} />`}
    </div>
    <div class="game-info">
      <p>You are <strong>${agent}</strong> against <strong class="ref">${opponent}</strong> <${Badge}>seed ${seed}<//></p>
      <label class="option"><input type="checkbox" checked=${showProbabilities} onChange=${(event) => setShowProbabilities(event.target.checked)} /><span>Show the policy's probabilities</span></label>
      ${showProbabilities && state?.chances?.length > 0 && !state.over && html`<h3>Policy's probabilities in your position</h3><${Probabilities} values=${state.chances} />`}
      ${state && html`<${MoveLog} steps=${state.steps} showProbabilities=${showProbabilities} />`}
      <div class="buttons">
        <button type="button" class=${state?.over ? "primary" : ""} onClick=${restart}>Play again</button>
        <button type="button" onClick=${undo} disabled=${!actions.length || busy}>Undo move</button>
        <button type="button" onClick=${() => navigate("#")}>Change opponent</button>
      </div>
    </div>
  </div>`;
}

/** Whose turn it is, or the result. */
function statusOf(state, busy, error, agent) {
  if (error) return "";
  if (!state) return "Loading …";
  if (state.over) return `${outcomeOf(state)} Your return is ${number(state.returns?.[agent] ?? 0, 2)}.`;
  return busy ? "Waiting for the opponent …" : "Your turn.";
}

/** The outcome from a score in [0, 1]; games without a score only have returns. */
function outcomeOf({ score }) {
  if (score == null) return "The game is over.";
  return score > 0.5 ? "You won." : score < 0.5 ? "You lost." : "Draw.";
}

function Board({ state, about, act, isTurn }) {
  const board = boardOf(about.environment);
  const last = state.steps.at(-1);
  return html`<${Picture} src=${state.picture} alt="Game after: ${describe(last)}">
    ${board && state.picture && !state.over && html`<div class="cells x${board.columns}" aria-hidden="true">${board.cells.map((action) => html`
      <button type="button" tabindex="-1" key=${action} disabled=${!isTurn || !state.legal.includes(action)} onClick=${() => act(action)} data-action=${action}></button>`)}</div>`}
  <//>`;
}

/** One button per action; digit keys select the first ten. Illegal actions are disabled. */
function Actions({ seat, legal, act, isTurn }) {
  const all = Array.from({ length: seat.actions }, (_, index) => seat.start + index);
  useKeys((key) => /^\d$/.test(key) && act(Number(key)));
  return html`<div class="actions-grid x${all.length <= 10 ? all.length : "many"}" role="group" aria-label="Your actions">${all.map((action) => html`
    <button type="button" key=${action} aria-disabled=${!isTurn || !legal.includes(action)} class=${legal.includes(action) ? "" : "illegal"} onClick=${() => act(action)}>
      ${action}</button>`)}</div>
    ${all.length <= 10 && html`<p class="muted small keys">Select an action, press its key (<kbd>${all[0]}</kbd> to <kbd>${all.at(-1)}</kbd>), or click the board.</p>`}`;
}

function MoveLog({ steps, showProbabilities }) {
  const moves = steps.filter((step) => step.moves.length);
  return html`<details open class="move-log"><summary>Moves</summary><ol reversed class="tall" tabindex="0">${[...moves].reverse().map((step) => html`<li key=${step.step} value=${step.step}>
    ${showProbabilities && step.moves.some((move) => move.chances?.length) ? html`<${Moves} step=${step} />` : describe(step)}</li>`)}</ol></details>`;
}
