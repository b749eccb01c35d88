// Keyboard shortcuts of a page, except for keys that the focused field, button or dialog handles itself.

import { useLayoutEffect, useRef } from "./vendor/preact-htm.js";

/** `onKey(key)` returns whether it has handled the key. */
export function useKeys(onKey) {
  const latest = useRef(onKey);
  latest.current = onKey;
  // A layout effect: an effect would run after the page is visible, and miss a key pressed before.
  useLayoutEffect(() => {
    const onKeyDown = (event) => {
      if (event.metaKey || event.ctrlKey || event.altKey || isHandledBy(event.target, event.key)) return;
      if (latest.current(event.key)) event.preventDefault();
    };
    addEventListener("keydown", onKeyDown);
    return () => removeEventListener("keydown", onKeyDown);
  }, []);
}

function isHandledBy(target, key) {
  const field = target.closest?.("dialog, select, textarea, input, button, a, summary");
  if (!field) return false;
  if (field.matches("button, a, summary, [type=checkbox]")) return key === " " || key === "Enter";
  if (field.matches("[type=range]")) return key.startsWith("Arrow") || key === "Home" || key === "End";
  return true;
}
