// Where everything begins: the bar above, the page that the address names, and the dialog for a key.

import { html, render, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { key, onKeyNeeded } from "./api.js";
import { League } from "./league.js";
import { Leagues } from "./leagues.js";
import { Dialog, Form, Notifications, sentence } from "./parts.js";
import { followLinks, matched, useAddress } from "./router.js";

const THEMES = ["system", "light", "dark"];
const ROUTES = [["/", "leagues"], ["/leagues", "leagues"]];

function App() {
  const { path } = useAddress();
  const [wanted, setWanted] = useState(null); // {sentence, done}: a key is asked for
  const [generation, setGeneration] = useState(0);
  const main = useRef();
  useEffect(() => onKeyNeeded((why) => new Promise((done) => setWanted({ why, done }))), []);
  const isFirst = useRef(true);
  useEffect(() => {
    // What had the focus may be gone with the page before.
    if (!isFirst.current && document.activeElement === document.body) main.current.focus({ preventScroll: true });
    isFirst.current = false;
  }, [path]);
  const close = (isNew) => {
    wanted.done(isNew);
    setWanted(null);
    if (isNew && wanted.renews) setGeneration((was) => was + 1);
  };
  const [isLeagues] = matched(ROUTES, path);
  return html`
    <a class="skip" href="#main" onClick=${(event) => { event.preventDefault(); main.current.focus(); }}>To the content</a>
    <header class="bar">
      <a class="brand" href="/"><img src="/pages/mark.svg" alt="" width="24" height="24" /><span>Policy League</span></a>
      <nav aria-label="Elsewhere"><a href="/docs">API</a></nav>
      <${Theme} />
      <button type="button" class="quiet" onClick=${() => setWanted({ why: "", done: () => {}, renews: true })}>
        ${key.get() ? "Key ✓" : "Key"}<span class="unseen">${key.get() ? ", entered" : ", none entered"}</span>
      </button>
    </header>
    <main id="main" tabindex="-1" ref=${main} key=${generation}>
      ${isLeagues ? html`<${Leagues} />` : html`<${League} path=${path} />`}
    </main>
    <${Notifications} />
    ${wanted && html`<${KeyDialog} why=${wanted.why} close=${close} />`}`;
}

function KeyDialog({ why, close }) {
  const submit = async (fields) => {
    key.set(fields.get("key").trim());
    close(true);
  };
  return html`<${Dialog} title="API key" onClose=${() => close(false)}>
    ${why && html`<p role="alert">${sentence(why)}</p>`}
    <p class="soft">It is kept in this tab until it is closed. <code>league keys create</code> makes one.</p>
    <${Form} submit=${submit} label="Use this key" onCancel=${() => close(false)}>
      <label class="field">Key <input name="key" type="password" autocomplete="off" spellcheck="false" required autofocus /></label>
    <//>
    ${key.get() && html`<p><button type="button" class="link" onClick=${() => { key.set(null); close(true); }}>Forget the key</button></p>`}
  <//>`;
}

function Theme() {
  const [theme, setTheme] = useState(() => document.documentElement.dataset.theme ?? "system");
  const choose = (event) => {
    const chosen = event.target.value;
    setTheme(chosen);
    if (chosen === "system") {
      delete document.documentElement.dataset.theme;
      localStorage.removeItem("theme");
    } else {
      document.documentElement.dataset.theme = chosen;
      localStorage.setItem("theme", chosen);
    }
    dispatchEvent(new Event("league:theme"));
  };
  return html`<label class="theme"><span class="unseen">Colours</span>
    <select value=${theme} onChange=${choose}>${THEMES.map((name) => html`<option value=${name}>${name[0].toUpperCase() + name.slice(1)}</option>`)}</select>
  </label>`;
}

followLinks();
render(html`<${App} />`, document.getElementById("app"));
