"use strict";
// Shows one image at a time, with buttons. Without this script, all images are shown as a list.
for (const game of document.querySelectorAll(".game")) {
  const frames = game.querySelector(".frames");
  if (!frames) continue;
  const steps = [...frames.children];
  const controls = document.createElement("div");
  controls.className = "controls";
  controls.setAttribute("role", "group");
  controls.setAttribute("aria-label", "Steps of the game");
  let at = 0, timer = null;

  const button = (text, label, act) => {
    const made = document.createElement("button");
    made.type = "button";
    made.textContent = text;
    made.setAttribute("aria-label", label);
    made.addEventListener("click", act);
    controls.append(made);
    return made;
  };
  const go = (to) => {
    at = Math.min(steps.length - 1, Math.max(0, to));
    steps.forEach((step, index) => { step.hidden = index !== at; });
    slider.value = at;
    slider.setAttribute("aria-valuetext", steps[at].querySelector("span").textContent);
    place.textContent = `${at + 1} of ${steps.length}`;
    if (at === steps.length - 1) pause();
  };
  const pause = () => {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
    play.setAttribute("aria-label", "Play");
    frames.setAttribute("aria-live", "polite");
  };
  const start = () => {
    go(at === steps.length - 1 ? 0 : at);
    frames.setAttribute("aria-live", "off");
    play.textContent = "Pause";
    play.setAttribute("aria-label", "Pause");
    timer = setInterval(() => go(at + 1), steps.length > 60 ? 120 : 700);
  };

  button("◀", "One step back", () => { pause(); go(at - 1); });
  const play = button("Play", "Play", () => (timer === null ? start() : pause()));
  play.className = "play";
  button("▶", "One step on", () => { pause(); go(at + 1); });
  const slider = document.createElement("input");
  slider.type = "range";
  slider.max = steps.length - 1;
  slider.setAttribute("aria-label", "Step");
  slider.addEventListener("input", () => { pause(); go(Number(slider.value)); });
  const place = document.createElement("output");
  controls.append(slider, place);
  frames.before(controls);
  game.classList.add("playing");
  go(0);
  pause();
}
