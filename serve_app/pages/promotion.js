// Dialogs to promote a version or roll back the champion.

import { html, useState } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { useChangeToken, useData, useMissingScope } from "./data.js";
import { Await, Dialog, ErrorNotice, Form, notify, Time } from "./components.js";

/** Whether a version can become champion: exploiters and retired versions cannot. */
export const canBePromoted = ({ role, retired_at: retiredAt }) => role !== "exploiter" && !retiredAt;

/** The buttons in the title of a league. */
export function Promotions({ league, champion }) {
  const [open, setOpen] = useState(null);
  const disabledReason = useMissingScope("promote", league);
  return html`<div class="actions">
    <button type="button" onClick=${() => setOpen("promote")} disabled=${disabledReason} title=${disabledReason}>Promote …</button>
    <button type="button" onClick=${() => setOpen("rollback")} disabled=${disabledReason || champion == null} title=${disabledReason}>Roll back …</button>
    ${open === "promote" && html`<${Promote} league=${league} champion=${champion} onClose=${() => setOpen(null)} />`}
    ${open === "rollback" && html`<${RollBack} league=${league} champion=${champion} onClose=${() => setOpen(null)} />`}
  </div>`;
}

/** If `version` is null, the user selects it in the dialog. */
export function Promote({ league, champion, version = null, onClose }) {
  const [selected, setSelected] = useState(version);
  const versions = useData(version == null ? apiPath(league, "versions") : null);
  const [current] = useState(champion); // the champion when the dialog was opened: the request fails if it has changed since
  const submit = async (fields) => {
    const body = { version: Number(selected), expected: current, reason: fields.get("reason") };
    await request(apiPath(league, "aliases", "champion"), { method: "POST", body });
    notify(`Promoted ${league}@${selected} to champion.`);
    onClose();
  };
  const others = versions.data?.versions.filter((each) => each.version !== current && canBePromoted(each)).reverse();
  return html`<${Dialog} title=${version == null ? `Promote a version of ${league}` : `Promote ${league}@${version}`} onClose=${onClose}>
    <${Form} submit=${submit} label=${selected == null ? "Promote" : `Promote @${selected}`} onCancel=${onClose} disabled=${selected == null}>
      ${version == null && html`<${Await} result=${versions}><label class="field">Version
        <select value=${selected ?? ""} onChange=${(event) => setSelected(event.target.value || null)} required>
          <option value="">Select …</option>
          ${others?.map((each) => html`<option value=${each.version}>${league}@${each.version}</option>`)}
        </select></label><//>`}
      ${selected != null && html`<p><strong class="ref">${league}@${selected}</strong> becomes champion${current == null
        ? ". The league has no champion yet."
        : html` and replaces <strong class="ref">${league}@${current}</strong>.`} All replicas switch within a second.</p>`}
      <${Reason} />
    <//>
  <//>`;
}

function RollBack({ league, champion, onClose }) {
  const history = useData(apiPath(league, "aliases", "champion", "history") + "?limit=1", useChangeToken("event"));
  const last = history.data && history.data.history[0];
  const submit = async (fields) => {
    const event = await request(apiPath(league, "rollback"), { method: "POST", body: { expected: last.version, reason: fields.get("reason") } });
    notify(`Rolled back to ${league}@${event.version}.`);
    onClose();
  };
  return html`<${Dialog} title="Roll back ${league}" onClose=${onClose}>
    <${Await} result=${history}>
      ${history.data && (last?.previous == null
        ? html`<${ErrorNotice} error=${{ message: `${league}@${champion} has no predecessor to roll back to.` }} />`
        : html`<${Form} submit=${submit} label="Roll back to @${last.previous}" tone="danger" onCancel=${onClose}>
            <p><strong class="ref">${league}@${last.previous}</strong> becomes champion again and replaces
              <strong class="ref"> ${league}@${last.version}</strong>, champion since <${Time} at=${last.at} date />.</p>
            <${Reason} />
          <//>`)}
    <//>
  <//>`;
}

function Reason() {
  return html`<label class="field">Reason
    <textarea name="reason" rows="2" maxlength="2000" required placeholder="Recorded in the history with the name of your key."></textarea></label>`;
}
