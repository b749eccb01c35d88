// Components that several pages use.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { count, dateTime, fullDateTime, OUTCOMES, plural, STATES, timeAgo } from "./format.js";
import { useTicks } from "./data.js";
import { report } from "./report.js";
import { ROOT } from "./router.js";

/** The page path of a league, or of something in it. */
export const leaguePath = (league, ...parts) => [`${ROOT}/leagues`, league, ...parts].map((part, index) => (index ? encodeURIComponent(part) : part)).join("/");

/** Set the document title; without a `name` it stays unchanged. */
export function useTitle(name, ...parts) {
  const title = name && [name, ...parts, "Policy League"].join(" · ");
  useEffect(() => { if (title) document.title = title; }, [title]);
}

/** Show the children once data is loaded; before that a loading message, or the error. The header shows that old data stays because the server is lost. */
export function Await({ result, message = "Loading …", children }) {
  if (result.data ?? result.items) return html`${result.error && result.error.code !== "network" && html`<${ErrorNotice} error=${result.error} retry=${result.retry} stale />`}${children}`;
  if (result.error) return html`<${ErrorNotice} error=${result.error} retry=${result.retry} />`;
  return html`<p class="loading muted" role="status">${message}</p>`;
}

export function ErrorNotice({ error, retry, stale }) {
  const title = { 401: "API key required", 403: "Permission denied", 404: "Not found" }[error.status];
  return html`<div class="notice bad" role="alert">
    <p><strong>${title ?? (stale ? "This data may be out of date" : "The request failed")}.</strong> ${sentence(error.message)}</p>
    ${retry && error.status !== 404 && html`<button type="button" onClick=${retry}>Retry</button>`}
  </div>`;
}

/** A message with a capital letter and a full stop. */
export function sentence(text) {
  const capitalized = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(capitalized) ? capitalized : `${capitalized}.`;
}

export function EmptyState({ children }) {
  return html`<p class="empty muted">${children}</p>`;
}

/** A relative time, or the date, as always in a report; the full time is in the tooltip. */
export function Time({ at, date }) {
  useTicks(10000);
  if (!at) return html`<span class="muted">–</span>`;
  return html`<time datetime=${at} title=${fullDateTime(at)}>${date || report ? dateTime(at) : timeAgo(at)}</time>`;
}

export function Badge({ tone = "plain", sign, children }) {
  return html`<span class="badge ${tone}">${sign && html`<span aria-hidden="true">${sign}</span> `}${children}</span>`;
}

export function Outcome({ value }) {
  const { sign, label, tone } = OUTCOMES[value ?? "open"] ?? { sign: "", label: value, tone: "plain" };
  return html`<${Badge} tone=${tone} sign=${sign}>${label}<//>`;
}

export function State({ value }) {
  const { sign, label, tone } = STATES[value] ?? { label: value };
  return html`<${Badge} tone=${tone} sign=${sign}>${label}<//>`;
}

const MAX_SHOWN = 120;

/** Text of people in a cell of a table: the beginning of a long one, which opens. */
export function LongText({ children: text }) {
  if (!text) return html`<span class="muted">–</span>`;
  if (text.length <= MAX_SHOWN) return text;
  return html`<details class="long"><summary>${text.slice(0, MAX_SHOWN)} …</summary>${text}</details>`;
}

/** A contestant, with a badge if it is the champion. */
export function Ref({ value, champion }) {
  const isChampion = champion != null && value.endsWith(`@${champion}`) && !value.startsWith("script:") && !value.includes("://");
  return html`<span class="ref">${value}</span>${isChampion && html` <${Badge} tone="accent" sign="★">champion<//>`}`;
}

/** A table that scrolls horizontally if it is too wide. `head`: [text or component, class, is visually hidden]. */
export function Table({ caption, head, children, showCaption = false, cls = "" }) {
  return html`<div class="wide" tabindex="0" role="region" aria-label=${caption}>
    <table class=${cls}>
      <caption class=${showCaption ? "" : "visually-hidden"}>${caption}</caption>
      <thead><tr>${head.map(([text, kind, isHidden]) =>
        html`<th scope="col" class=${kind}>${isHidden ? html`<span class="visually-hidden">${text}</span>` : text}</th>`)}</tr></thead>
      <tbody>${children}</tbody>
    </table>
  </div>`;
}

export function ShowMore({ list }) {
  return list.more && html`<p class="more"><button type="button" onClick=${list.more}>Show more</button></p>`;
}

/** Names and values. `items`: [name, value, class]; falsy items are left out. */
export function Properties({ items, cls = "" }) {
  return html`<dl class="properties ${cls}">${items.filter(Boolean).map(([name, value, kind]) =>
    html`<div class=${kind ?? ""}><dt>${name}</dt><dd>${value}</dd></div>`)}</dl>`;
}

let dialogCount = 0; // a form dialog and the API key dialog may be open at the same time

/** A modal dialog. `onClose` is called however it is closed. */
export function Dialog({ title, onClose, children }) {
  const dialog = useRef();
  const [heading] = useState(() => `dialog-${(dialogCount += 1)}`);
  useEffect(() => {
    const element = dialog.current;
    element.showModal();
    return () => element.close(); // restores the focus
  }, []);
  return html`<dialog ref=${dialog} aria-labelledby=${heading} onClose=${onClose}
      onClick=${(event) => event.target === dialog.current && onClose()}>
    <div class="inside"><h2 id=${heading}>${title}</h2>${children}</div>
  </dialog>`;
}

/** A form that sends a request. While it is in progress the button is busy; an error is shown below the fields. */
export function Form({ submit, label, tone = "primary", onCancel, children, disabled }) {
  const [busy, setBusy] = useState(false);
  const [error, setError] = useState(null);
  const isMounted = useRef(true);
  useEffect(() => () => { isMounted.current = false; }, []);
  const send = async (event) => {
    event.preventDefault();
    if (busy) return;
    setBusy(true);
    setError(null);
    try {
      await submit(new FormData(event.target));
    } catch (failure) {
      if (isMounted.current) setError(failure);
    }
    if (isMounted.current) setBusy(false);
  };
  return html`<form onSubmit=${send}>
    ${children}
    ${error && html`<${ErrorNotice} error=${error} />`}
    <div class="buttons">
      <button type="submit" class=${tone} disabled=${disabled} aria-busy=${busy}>${busy ? "Please wait …" : label}</button>
      ${onCancel && html`<button type="button" onClick=${onCancel}>Cancel</button>`}
    </div>
  </form>`;
}

const listeners = new Set();

/** Show a message for a few seconds. */
export function notify(text) {
  listeners.forEach((listener) => listener(text));
}

export function Notifications() {
  const [text, setText] = useState("");
  useEffect(() => { listeners.add(setText); return () => listeners.delete(setText); }, []);
  useEffect(() => {
    const timer = text && setTimeout(() => setText(""), 8000);
    return () => clearTimeout(timer);
  }, [text]);
  return html`<div class="toast" role="status">${text && html`<p>${text}</p>`}</div>`;
}

/** A progress bar with the number of matches. */
export function Progress({ played, of, label = "Progress" }) {
  const share = of ? played / of : 0;
  return html`<div class="progress">
    <progress max="1" value=${share} aria-label=${label}></progress>
    <span class="muted">${plural(played, "match", "matches")} of at most ${count(of)}</span>
  </div>`;
}
