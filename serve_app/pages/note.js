// The note of a version, and the dialog to edit it.

import { html } from "./vendor/preact-htm.js";
import { apiPath, request } from "./api.js";
import { Dialog, Form, LongText, notify, Time } from "./components.js";
import { Live } from "./report.js";

/** The note in the list of versions, with a button to add or edit it. */
export function Note({ note, name, edit, disabledReason }) {
  return html`${note && html`<span title="${note.actor}"><${LongText}>${note.text}<//></span> `}
    <${Live}><button type="button" class="small" onClick=${edit} disabled=${disabledReason} title=${disabledReason} aria-label="${note ? "Edit the note of" : "Add a note to"} ${name}">
      ${note ? "Edit …" : "Add …"}</button><//>`;
}

export function EditNote({ league, version, note, onClose }) {
  const name = `${league}@${version}`;
  const submit = async (fields) => {
    const text = fields.get("note");
    await request(apiPath(league, "versions", version, "note"), { method: "PUT", body: { note: text }, repeatable: true });
    notify(text.trim() ? `The note of ${name} was saved.` : `The note of ${name} was deleted.`);
    onClose();
  };
  return html`<${Dialog} title="Note of ${name}" onClose=${onClose}>
    <${Form} submit=${submit} label="Save" onCancel=${onClose}>
      <label class="field">Note
        <textarea name="note" rows="4" maxlength="2000" placeholder="For example what is different about this version. Visible to all users with read access, with the name of your key.">${note?.text}</textarea></label>
      ${note && html`<p class="muted small">Written by ${note.actor}, <${Time} at=${note.at} />. Save an empty note to delete it.</p>`}
    <//>
  <//>`;
}
