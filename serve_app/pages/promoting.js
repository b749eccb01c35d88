// The champion is moved by hand: promoted, or rolled back, for a reason, after saying which version takes whose place.

import { html, useState } from "./vendor/preact-htm.js";
import { ask, of } from "./api.js";
import { useData, useMark, useRefusal } from "./data.js";
import { Await, Dialog, Form, notify, sentence, Trouble, When } from "./parts.js";

/** The buttons of a league's title. */
export function Promotions({ league, champion }) {
  const [open, setOpen] = useState(null);
  const refusal = useRefusal("promote", league);
  return html`<div class="actions">
    <button type="button" onClick=${() => setOpen("promote")} disabled=${refusal} title=${refusal}>Promote …</button>
    <button type="button" onClick=${() => setOpen("rollback")} disabled=${refusal || champion == null} title=${refusal}>Roll back …</button>
    ${open === "promote" && html`<${Promote} league=${league} champion=${champion} onClose=${() => setOpen(null)} />`}
    ${open === "rollback" && html`<${RollBack} league=${league} champion=${champion} onClose=${() => setOpen(null)} />`}
  </div>`;
}

/** `version` null: it is chosen in the dialog. */
export function Promote({ league, champion, version = null, onClose }) {
  const [chosen, setChosen] = useState(version);
  const versions = useData(version == null ? of(league, "versions") : null);
  const [before] = useState(champion); // whom the person sees, and so whom the change expects
  const submit = async (fields) => {
    const body = { version: Number(chosen), expected: before, reason: fields.get("reason") };
    await ask(of(league, "aliases", "champion"), { method: "POST", body });
    notify(`${league}@${chosen} is the champion.`);
    onClose();
  };
  const others = versions.data?.versions.filter((each) => each.version !== before).reverse();
  return html`<${Dialog} title=${version == null ? `Promote a version of ${league}` : `Promote ${league}@${version}`} onClose=${onClose}>
    <${Form} submit=${submit} label=${chosen == null ? "Promote" : `Promote @${chosen}`} onCancel=${onClose} disabled=${chosen == null}>
      ${version == null && html`<${Await} of=${versions}><label class="field">Version
        <select value=${chosen ?? ""} onChange=${(event) => setChosen(event.target.value || null)} required>
          <option value="">Choose …</option>
          ${others?.map((each) => html`<option value=${each.version}>${league}@${each.version}</option>`)}
        </select></label><//>`}
      ${chosen != null && html`<p><strong class="ref">${league}@${chosen}</strong> becomes the champion${before == null
        ? ", the first one of this league."
        : html` instead of <strong class="ref">${league}@${before}</strong>.`} Every replica follows within a second.</p>`}
      <${Reason} />
    <//>
  <//>`;
}

function RollBack({ league, champion, onClose }) {
  const history = useData(of(league, "aliases", "champion", "history") + "?limit=1", useMark("event"));
  const last = history.data && history.data.history[0];
  const submit = async (fields) => {
    const event = await ask(of(league, "rollback"), { method: "POST", body: { reason: fields.get("reason") } });
    notify(`${league}@${event.version} is the champion again.`);
    onClose();
  };
  return html`<${Dialog} title="Roll ${league} back" onClose=${onClose}>
    <${Await} of=${history}>
      ${history.data && (last?.previous == null
        ? html`<${Trouble} fault=${{ message: sentence(`${league} has no champion before ${league}@${champion}`) }} />`
        : html`<${Form} submit=${submit} label="Roll back to @${last.previous}" tone="danger" onCancel=${onClose}>
            <p><strong class="ref">${league}@${last.previous}</strong> becomes the champion again, instead of
              <strong class="ref"> ${league}@${last.version}</strong>, which has been it since <${When} at=${last.at} date />.</p>
            <${Reason} />
          <//>`)}
    <//>
  <//>`;
}

function Reason() {
  return html`<label class="field">Reason
    <textarea name="reason" rows="2" maxlength="2000" required placeholder="It is kept in the history, with the key's name."></textarea></label>`;
}
