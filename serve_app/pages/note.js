// What people write of a version: shown with it, and written anew in a dialog.

import { html } from "./vendor/preact-htm.js";
import { ask, of } from "./api.js";
import { Dialog, Form, notify, When } from "./parts.js";

/** The note in a list of versions, and the button to write one. */
export function Note({ of: note, name, write, refusal }) {
  return html`${note && html`<span title="${note.actor}">${note.text}</span> `}
    <button type="button" class="small" onClick=${write} disabled=${refusal} title=${refusal} aria-label="${note ? "Change the note of" : "Write a note of"} ${name}">
      ${note ? "Change …" : "Write …"}</button>`;
}

export function WriteNote({ league, version, note, onClose }) {
  const name = `${league}@${version}`;
  const submit = async (fields) => {
    const text = fields.get("note");
    await ask(of(league, "versions", version, "note"), { method: "PUT", body: { note: text }, repeatable: true });
    notify(text.trim() ? `The note of ${name} is written.` : `${name} has no note any more.`);
    onClose();
  };
  return html`<${Dialog} title="Note of ${name}" onClose=${onClose}>
    <${Form} submit=${submit} label="Keep it" onCancel=${onClose}>
      <label class="field">Note
        <textarea name="note" rows="4" maxlength="2000" placeholder="What was tried in it, or came of it. Everybody who may look sees it, with the key's name.">${note?.text}</textarea></label>
      ${note && html`<p class="soft small">Written by ${note.actor}, <${When} at=${note.at} />. Without a word it is taken away.</p>`}
    <//>
  <//>`;
}
