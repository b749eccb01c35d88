// Keys that are pressed anywhere on a page, but for those that a field, a button or a dialog takes itself.

import { useEffect, useRef } from "./vendor/preact-htm.js";

/** `pressed(key)` returns whether the key meant something. */
export function useKeys(pressed) {
  const latest = useRef(pressed);
  latest.current = pressed;
  useEffect(() => {
    const press = (event) => {
      if (event.metaKey || event.ctrlKey || event.altKey || isTaken(event.target, event.key)) return;
      if (latest.current(event.key)) event.preventDefault();
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, []);
}

function isTaken(target, key) {
  const field = target.closest?.("dialog, select, textarea, input, button, a, summary");
  if (!field) return false;
  if (field.matches("button, a, summary, [type=checkbox]")) return key === " " || key === "Enter";
  if (field.matches("[type=range]")) return key.startsWith("Arrow") || key === "Home" || key === "End";
  return true;
}
