// Statistical terms with a short explanation: as a tooltip, and on a click or tap as a box below the term.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";

const EXPLANATIONS = {
  rating: "Strength in Elo: 0 is script:random. A contestant that is 100 points stronger scores about 64 % against the other, 200 points about 76 %. In 95 % of all cases, the true rating lies in the interval.",
  LLR: "Log-likelihood ratio: the evidence that the candidate is stronger, from all blocks so far. Each block adds to it or takes from it. The candidate is promoted at the upper bound and rejected at the lower one.",
  "log wealth": "Evidence that the candidate's mean return is higher: the logarithm of the wealth of a bettor who bets on it in each block. The candidate is promoted at the upper bound.",
  block: "Two games from the same seed and the same opening. The contestants swap sides, so that neither has an advantage; with one side, each plays one of the games. It is the unit of evidence.",
};

let termCount = 0; // a page can contain a term several times

/** A term with its explanation; without one, the text alone. */
export function Term({ name, children }) {
  const [id] = useState(() => `term-${(termCount += 1)}`);
  const [isOpen, setIsOpen] = useState(false);
  const root = useRef();
  useEffect(() => {
    if (!isOpen) return undefined;
    const close = (event) => { if (!root.current.contains(event.target)) setIsOpen(false); };
    addEventListener("pointerdown", close);
    return () => removeEventListener("pointerdown", close);
  }, [isOpen]);
  const text = children ?? name;
  if (!EXPLANATIONS[name]) return text;
  return html`<span class="term" ref=${root} onKeyDown=${(event) => event.key === "Escape" && setIsOpen(false)}><button type="button" class="quiet" title=${EXPLANATIONS[name]} aria-expanded=${isOpen} aria-controls=${id}
      onClick=${() => setIsOpen(!isOpen)}>${text}</button><span id=${id} class="explanation" role="note" hidden=${!isOpen}>${EXPLANATIONS[name]}</span></span>`;
}
