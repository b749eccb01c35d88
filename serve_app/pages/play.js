// Play against a policy. The address contains the whole game: opponent, seat, seed and actions. The server keeps no state.

import { html, useEffect, useState } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { hasOneSide, useData } from "./data.js";
import { useKeys } from "./keyboard.js";
import { Await, Badge, EmptyState, ErrorNotice, sentence } from "./components.js";
import { navigate, useAddress } from "./router.js";
import { actionName, Analyst, describe, Moves, Picture, Probabilities } from "./step.js";
import { count, number } from "./format.js";

const SEED_LIMIT = 2 ** 31;

export function Play({ league, about }) {
  const playable = useData(apiPath(league, "playable"));
  const game = parseGame(useAddress().fragment);
  return html`<section aria-labelledby="heading">
    <div class="head"><h2 id="heading">Play</h2></div>
    <${Await} result=${playable} message="Starting the evaluation service …">${playable.data && (playable.data.playable
      ? game ? html`<${Game} key=${`${game.agent} ${game.seed}`} league=${league} about=${about} playable=${playable.data} game=${game} />`
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
  const isTeam = hasOneSide(about);
  return html`<form class="narrow" onSubmit=${start}>
    <p class="muted">You play one agent. ${isTeam ? "A policy plays all others, your teammates." : "The opponent plays all others."} As in the matches of this league, versions ${about.actions === "sampled" ? "sample their actions" : "take their most likely actions"}.</p>
    <label class="field">${isTeam ? "Teammates" : "Opponent"} <select name="opponent">
      ${about.champion != null && html`<option value="${league}@champion">${league}@champion (version ${about.champion})</option>`}
      ${playable.opponents.map((ref) => html`<option value=${ref}>${ref}</option>`)}
    </select></label>
    <label class="field">Your agent <select name="agent">${playable.agents.map(({ agent, side }) => html`<option value=${agent}>${agent}${side && side !== agent ? ` (${side})` : ""}</option>`)}</select></label>
    <label class="field">Seed <input name="seed" type="number" min="0" max=${SEED_LIMIT - 1} placeholder="random" /></label>
    <div class="buttons"><button type="submit" class="primary">Start game</button></div>
  </form>`;
}

function Game({ league, about, playable, game }) {
  const [showProbabilities, setShowProbabilities] = useState(false);
  const [analysis, setAnalysis] = useState(null);
  const [state, setState] = useState(null);
  const [error, setError] = useState(null);
  const [answered, setAnswered] = useState(null);
  const [attempt, setAttempt] = useState(0);
  const { opponent, agent, seed, actions } = game;
  const requestKey = `${actions.join()} ${showProbabilities} ${analysis} ${attempt}`;
  const busy = answered !== requestKey; // at once: a second click is no second move
  useEffect(() => {
    const closed = new AbortController();
    request(apiPath(league, "play"), { method: "POST", body: { opponent, agent, seed, actions, chances: showProbabilities, analysis }, signal: closed.signal, repeatable: true }).then(
      (loaded) => { if (!closed.signal.aborted) { setState(loaded); setError(null); setAnswered(requestKey); if (loaded.opponent !== opponent) navigate(fragmentOf({ ...game, opponent: loaded.opponent }), { replace: true }); } },
      (failure) => { if (!closed.signal.aborted) { setError(failure); setAnswered(requestKey); } },
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
  const seat = playable.agents.find((each) => each.agent === agent);
  const names = Object.fromEntries(playable.agents.map((each) => [each.agent, each.names]));
  const isTeam = hasOneSide(about);
  return html`<div class="player">
    <div class="screen">
      <p class="turn" role="status">${statusOf(state, busy, error, agent, isTeam)}</p>
      ${state && html`<${Board} state=${state} playable=${playable} names=${names} act=${act} isTurn=${isTurn}>
        ${seat && !state.over && html`<${Actions} seat=${seat} board=${state.picture && playable.board} legal=${state.legal} act=${act} isTurn=${isTurn} />`}<//>`}
      ${playable.reveals && html`<p class="notice">The picture shows everything, also what is hidden from ${agent}: this environment does not render the view of one agent.</p>`}
      ${error && html`<${ErrorNotice} error=${error} retry=${() => setAttempt(attempt + 1)} />`}
    </div>
    <div class="game-info">
      <p>You are <strong>${agent}</strong> ${isTeam ? "with" : "against"} <strong class="ref">${opponent}</strong> <${Badge}>seed ${seed}<//></p>
      <${Agents} sides=${about.sides} agents=${playable.agents} own=${agent} opponent=${opponent} />
      <label class="option"><input type="checkbox" checked=${showProbabilities} onChange=${(event) => setShowProbabilities(event.target.checked)} /><span>Show the policy's probabilities</span></label>
      <${Analyst} league=${league} value=${analysis} onChange=${setAnalysis} />
      ${state?.chances?.length > 0 && !state.over && html`<h3>${analysis == null ? "Policy's probabilities in your position" : `Best move: ${actionName(names[agent], state.chances[0][0])}`}</h3>
        ${state.value != null && html`<p class="muted small">expected return ${number(state.value, 2)}</p>`}<${Probabilities} values=${state.chances} names=${names[agent]} />`}
      ${state && html`<${MoveLog} steps=${state.steps} names=${names} showProbabilities=${showProbabilities} />`}
      <div class="buttons">
        <button type="button" class=${state?.over ? "primary" : ""} onClick=${restart}>Play again</button>
        <button type="button" onClick=${undo} disabled=${!actions.length || busy}>Undo move</button>
        <button type="button" onClick=${() => navigate("#")}>Change ${isTeam ? "teammates" : "opponent"}</button>
      </div>
    </div>
  </div>`;
}

/** Whose turn it is, or the result. */
function statusOf(state, busy, error, agent, isTeam) {
  if (error) return "";
  if (!state) return "Loading …";
  if (state.over) return `${outcomeOf(state)} Your return is ${number(state.returns?.[agent] ?? 0, 2)}.`;
  return busy ? `Waiting for the ${isTeam ? "teammates" : "opponent"} …` : "Your turn.";
}

/** The outcome from a score in [0, 1]; games without a score only have returns. */
function outcomeOf({ score }) {
  if (score == null) return "The game is over.";
  return score > 0.5 ? "You won." : score < 0.5 ? "You lost." : "Draw.";
}

/** The picture; if the environment declares a board, its cells can be clicked. The children have the width of the board. */
function Board({ state, playable: { board, board_area: area }, names, act, isTurn, children }) {
  const [left, top, right, bottom] = area.map((share) => 100 * share);
  const edges = { "--left": `${left}%`, "--top": `${top}%`, "--right": `${100 - right}%`, "--bottom": `${100 - bottom}%`, "--columns": board?.[0].length };
  return html`<div class="board" style=${edges}>
    <${Picture} src=${state.picture} alt="Game after: ${describe(state.steps.at(-1), names)}">
      ${board && state.picture && !state.over && html`<div class="cells" aria-hidden="true">${board.flat().map((action) => action == null ? html`<span></span>` : html`
        <button type="button" tabindex="-1" disabled=${!isTurn || !state.legal.includes(action)} onClick=${() => act(action)} data-action=${action}></button>`)}</div>`}
    <//>${children}
  </div>`;
}

/** A sample of an agent's color in the pictures. */
function AgentColor({ color }) {
  return color && html`<svg class="agent-color" viewBox="0 0 12 12" width="12" height="12" role="img" aria-label=${color}><circle cx="6" cy="6" r="5" fill=${color} /></svg> `;
}

const MAX_AGENTS = 12;

/** All agents, with their colors in the pictures and their relation to the person. */
function Agents({ sides, agents, own, opponent }) {
  const colors = Object.fromEntries(agents.map((each) => [each.agent, each.color]));
  const side = Object.keys(sides).find((name) => sides[name].includes(own));
  const all = Object.entries(sides).flatMap(([name, members]) => members.map((agent) => ({ agent, relation: agent === own ? "you" : name === side ? "teammate" : "opponent" })));
  if (all.length > MAX_AGENTS) {
    const teammates = all.filter(({ relation }) => relation === "teammate").length;
    return html`<p class="muted small">${count(teammates)} teammates and ${count(all.length - teammates - 1)} opponents: <span class="ref">${opponent}</span></p>`;
  }
  return html`<ul class="agents small" aria-label="Agents">${all.map(({ agent, relation }) => html`<li key=${agent} class=${relation === "you" ? "strong" : "muted"}>
    <${AgentColor} color=${colors[agent]} />${agent} · ${relation}</li>`)}</ul>`;
}

/** One button per action; digit keys select the first ten, and other keys as the server lists them. Illegal actions are disabled. */
function Actions({ seat, board, legal, act, isTurn }) {
  const all = Array.from({ length: seat.actions }, (_, index) => seat.start + index);
  const columns = board && actionOfColumns(board);
  const isAligned = columns?.length === all.length && all.every((action) => columns.includes(action));
  const isNamed = Object.keys(seat.names).length > 0;
  useKeys((key) => {
    const action = seat.keys[key] ?? seat.keys[key.toLowerCase()] ?? (/^\d$/.test(key) ? Number(key) : null);
    if (action != null) act(action);
    return action != null; // the page must not scroll while it is not the person's turn
  });
  const layout = isAligned ? "aligned" : isNamed ? "named" : `x${all.length <= 10 ? all.length : "many"}`;
  return html`<div class="actions-grid ${layout}" role="group" aria-label="Your actions">${(isAligned ? columns : all).map((action) => html`
    <button type="button" key=${action} aria-disabled=${!isTurn || !legal.includes(action)} class=${legal.includes(action) ? "" : "illegal"} onClick=${() => act(action)}>
      ${actionName(seat.names, action)}</button>`)}</div>
    <p class="muted small keys">${ways(seat, all, !!board)}</p>`;
}

/** The action of each column of a board, or null if a column has several. */
function actionOfColumns(board) {
  const columns = board[0].map((_, index) => [...new Set(board.map((row) => row[index]).filter((action) => action != null))]);
  return columns.every((actions) => actions.length === 1) ? columns.flat() : null;
}

/** How actions can be selected, as a sentence. */
function ways(seat, all, hasBoard) {
  const keys = [...new Set([...Object.keys(seat.keys), ...(all.length <= 10 ? all.filter((action) => action < 10 && !isNamedKey(seat, action)) : [])])].map((key) => keyName(String(key)));
  const pressed = keys.length > 0 && html`press a key (${keys.map((key) => html`<kbd key=${key}>${key}</kbd> `)})`;
  return html`Select an action${pressed && html`, or ${pressed}`}${hasBoard && ", or click the board"}.`;
}

/** Whether an action has a key of its own, so that its digit need not be listed. */
const isNamedKey = (seat, action) => Object.values(seat.keys).includes(action);

const keyName = (key) => ({ ArrowUp: "↑", ArrowDown: "↓", ArrowLeft: "←", ArrowRight: "→", " ": "Space" })[key] ?? (key.length === 1 ? key.toUpperCase() : key);

function MoveLog({ steps, names, showProbabilities }) {
  const moves = steps.filter((step) => step.moves.length);
  return html`<details open class="move-log"><summary>Moves</summary><ol reversed class="tall" tabindex="0">${[...moves].reverse().map((step) => html`<li key=${step.step} value=${step.step}>
    ${showProbabilities && step.moves.some((move) => move.chances?.length) ? html`<${Moves} step=${step} names=${names} />` : describe(step, names)}</li>`)}</ol></details>`;
}
