// Small parts that several pages are made of.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { OUTCOMES, STATES, ago, exactly, moment, several, tail } from "./words.js";
import { useTicks } from "./data.js";

export const league = (name, ...parts) => ["/leagues", name, ...parts].map((part, at) => (at ? encodeURIComponent(part) : part)).join("/");

/** The page's title, for the tab and for who listens; without a `name` it stays. */
export function useTitle(name, ...parts) {
  const title = name && [name, ...parts, "Policy League"].join(" · ");
  useEffect(() => { if (title) document.title = title; }, [title]);
}

/** What is shown while data comes, or instead of it. */
export function Await({ of, words = "Loading …", children }) {
  if (of.data ?? of.items) return html`${of.fault && html`<${Trouble} fault=${of.fault} again=${of.again} stale />`}${children}`;
  if (of.fault) return html`<${Trouble} fault=${of.fault} again=${of.again} />`;
  return html`<p class="loading soft" role="status">${words}</p>`;
}

export function Trouble({ fault, again, stale }) {
  const title = { 401: "A key is needed", 403: "This key is not for that", 404: "There is no such thing here" }[fault.status];
  return html`<div class="notice bad" role="alert">
    <p><strong>${title ?? (stale ? "This is no longer up to date" : "That did not work")}.</strong> ${sentence(fault.message)}</p>
    ${again && fault.status !== 404 && html`<button type="button" onClick=${again}>Try again</button>`}
  </div>`;
}

export function sentence(text) {
  const begun = text.charAt(0).toUpperCase() + text.slice(1);
  return /[.!?]$/.test(begun) ? begun : `${begun}.`;
}

export function Empty({ children }) {
  return html`<p class="empty soft">${children}</p>`;
}

/** A time: how long ago, and exactly for who points at it. */
export function When({ at, date }) {
  useTicks(10000);
  if (!at) return html`<span class="soft">–</span>`;
  return html`<time datetime=${at} title=${exactly(at)}>${date ? moment(at) : ago(at)}</time>`;
}

export function Badge({ tone = "plain", sign, children }) {
  return html`<span class="badge ${tone}">${sign && html`<span aria-hidden="true">${sign}</span> `}${children}</span>`;
}

export function Outcome({ of }) {
  const { sign, word, tone } = OUTCOMES[of ?? "open"] ?? { sign: "", word: of, tone: "plain" };
  return html`<${Badge} tone=${tone} sign=${sign}>${word}<//>`;
}

export function State({ of }) {
  const { sign, tone } = STATES[of] ?? {};
  return html`<${Badge} tone=${tone} sign=${sign}>${of}<//>`;
}

/** A version as it stands everywhere: its number, and what it is. */
export function Ref({ of, champion, short }) {
  const isChampion = champion != null && of.endsWith(`@${champion}`) && !of.startsWith("script:");
  return html`<span class="ref">${short ? tail(of) : of}</span>${isChampion && html` <${Badge} tone="accent" sign="★">champion<//>`}`;
}

/** A table that scrolls by itself where it is too wide; `head`: [text, class] pairs. */
export function Table({ caption, head, children, hidden = true, cls = "" }) {
  return html`<div class="wide" tabindex="0" role="region" aria-label=${caption}>
    <table class=${cls}>
      <caption class=${hidden ? "unseen" : ""}>${caption}</caption>
      <thead><tr>${head.map(([text, kind, unseen]) =>
        html`<th scope="col" class=${kind}>${unseen ? html`<span class="unseen">${text}</span>` : text}</th>`)}</tr></thead>
      <tbody>${children}</tbody>
    </table>
  </div>`;
}

export function More({ of }) {
  return of.more && html`<p class="more"><button type="button" onClick=${of.more}>Show more</button></p>`;
}

export function Facts({ of, cls = "" }) {
  return html`<dl class="facts ${cls}">${of.filter(Boolean).map(([name, value, kind]) =>
    html`<div class=${kind ?? ""}><dt>${name}</dt><dd>${value}</dd></div>`)}</dl>`;
}

let dialogs = 0; // two may be open: a form's, and that for the key which it needs

/** A modal dialog; `onClose` when it was closed in any way. */
export function Dialog({ title, onClose, children }) {
  const dialog = useRef();
  const [heading] = useState(() => `dialog-${(dialogs += 1)}`);
  useEffect(() => {
    const shown = dialog.current;
    shown.showModal();
    return () => shown.close(); // the focus goes back to where it was
  }, []);
  return html`<dialog ref=${dialog} aria-labelledby=${heading} onClose=${onClose}
      onClick=${(event) => event.target === dialog.current && onClose()}>
    <div class="inside"><h2 id=${heading}>${title}</h2>${children}</div>
  </dialog>`;
}

/** A form that asks the server for something: its button is busy meanwhile, and what went wrong is said below. */
export function Form({ submit, label, tone = "primary", onCancel, children, disabled }) {
  const [busy, setBusy] = useState(false);
  const [fault, setFault] = useState(null);
  const here = useRef(true);
  useEffect(() => () => { here.current = false; }, []);
  const send = async (event) => {
    event.preventDefault();
    if (busy) return;
    setBusy(true);
    setFault(null);
    try {
      await submit(new FormData(event.target));
    } catch (error) {
      if (here.current) setFault(error);
    }
    if (here.current) setBusy(false);
  };
  return html`<form onSubmit=${send}>
    ${children}
    ${fault && html`<${Trouble} fault=${fault} />`}
    <div class="buttons">
      <button type="submit" class=${tone} disabled=${disabled} aria-busy=${busy}>${busy ? "One moment …" : label}</button>
      ${onCancel && html`<button type="button" onClick=${onCancel}>Cancel</button>`}
    </div>
  </form>`;
}

const said = new Set();

/** Say something that has happened, for a few seconds. */
export function notify(text) {
  said.forEach((hear) => hear(text));
}

export function Notifications() {
  const [text, setText] = useState("");
  useEffect(() => { said.add(setText); return () => said.delete(setText); }, []);
  useEffect(() => {
    const timer = text && setTimeout(() => setText(""), 8000);
    return () => clearTimeout(timer);
  }, [text]);
  return html`<div class="said" role="status">${text && html`<p>${text}</p>`}</div>`;
}

/** How far something is. */
export function Progress({ played, of, what }) {
  const share = of ? played / of : 0;
  return html`<div class="progress">
    <progress max="1" value=${share} aria-label=${what ?? "Progress"}></progress>
    <span class="soft">${several(played, "match", "matches")} of at most ${several(of, "match", "matches").split(" ")[0]}</span>
  </div>`;
}
