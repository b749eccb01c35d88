// Curves, drawn by uPlot in the page's own colours. What a chart shows is said in words, and in a table below it.

import { html, useEffect, useRef, useState } from "./vendor/preact-htm.js";
import { short } from "./words.js";

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [4, 2], [12, 4]];
/** With the six colours these tell 36 lines apart. */
const dashOf = (number) => DASHES[(number + Math.floor(number / 6)) % 6];
const FONT = "12px system-ui, sans-serif";

/**
 * `x`: the places, ascending. `lines`: {name, values, dots} over them, null where there is none; dots: whether each has one.
 * `levels`: {name, value, tone} across. `spans`: [low, high] or null over each place of the first line.
 * `stars`: at which places the first line is marked. `words`: a value → how it is written.
 */
export function Chart({ label, x, lines, levels = [], spans, stars, xName, yName, height = 260, words = short }) {
  const place = useRef();
  const plot = useRef(null);
  const [at, setAt] = useState(null);
  const renewed = useRedrawn();
  const shape = JSON.stringify([lines.map((line) => line.name), levels, xName, yName, height, !!spans, !!stars, renewed]);
  const latest = useRef();
  latest.current = { x, lines, levels, spans, stars };

  useEffect(() => {
    let watching = null;
    let gone = false;
    import("./vendor/uplot.js").then(({ default: UPlot }) => {
      if (gone) return;
      const look = colours(place.current);
      const options = optionsOf({ look, latest, xName, yName, height, words, width: place.current.clientWidth, moved: setAt });
      plot.current = new UPlot(options, dataOf(latest.current), place.current);
      place.current.querySelector("canvas").setAttribute("aria-hidden", "true");
      watching = new ResizeObserver(([{ contentRect }]) => plot.current.setSize({ width: contentRect.width, height }));
      watching.observe(place.current);
    });
    return () => {
      gone = true;
      watching?.disconnect();
      plot.current?.destroy();
      plot.current = null;
    };
  }, [shape]);
  useEffect(() => { plot.current?.setData(dataOf(latest.current)); }, [x, lines, spans, stars]);

  return html`<figure class="chart">
    <div class="plot" style=${{ minHeight: `${height}px` }} ref=${place} role="img" aria-label=${label}></div>
    <figcaption><ul class="legend">${lines.map((line, number) => html`<li>
      <svg viewBox="0 0 26 8" width="26" height="8" aria-hidden="true"><line class="line c${number % 6}" x1="0" x2="26" y1="4" y2="4" stroke-dasharray=${dashOf(number).join(" ")} /></svg>
      ${line.name} <span class="value">${words(line.values[at ?? last(line.values)])}</span></li>`)}
      <li class="soft place">${at != null && `${xName} ${short(x[at])}`}</li></ul></figcaption>
  </figure>`;
}

/** A chart's numbers, for who does not see it or wants them exactly. */
export function Numbers({ x, lines, xName, caption, words = short }) {
  const [isOpen, setIsOpen] = useState(false);
  return html`<details class="numbers" onToggle=${(event) => setIsOpen(event.target.open)}><summary>As a table</summary>
    ${isOpen && html`<div class="wide tall" tabindex="0" role="region" aria-label=${caption}><table>
      <caption class="unseen">${caption}</caption>
      <thead><tr><th scope="col" class="number">${xName}</th>${lines.map((line) => html`<th scope="col" class="number">${line.name}</th>`)}</tr></thead>
      <tbody>${x.map((value, row) => html`<tr><th scope="row" class="number">${short(value)}</th>${lines.map((line) => html`<td class="number">${words(line.values[row])}</td>`)}</tr>`)}</tbody>
    </table></div>`}
  </details>`;
}

/** A number that changes when charts must be drawn anew: in other colours. */
function useRedrawn() {
  const [times, setTimes] = useState(0);
  useEffect(() => {
    const scheme = matchMedia("(prefers-color-scheme: dark)");
    const again = () => setTimes((was) => was + 1);
    scheme.addEventListener("change", again);
    addEventListener("league:theme", again);
    return () => { scheme.removeEventListener("change", again); removeEventListener("league:theme", again); };
  }, []);
  return times;
}

/** The page's colours as a canvas takes them: by a look at what they are just now. */
function colours(element) {
  const probe = element.appendChild(document.createElement("i"));
  const names = ["ink", "soft", "line", "paper", "good", "bad", "accent", "c0", "c1", "c2", "c3", "c4", "c5"];
  const found = names.map((name) => {
    probe.style.color = `var(--${name})`;
    return [name, getComputedStyle(probe).color];
  });
  probe.remove();
  return Object.fromEntries(found);
}

const dataOf = ({ x, lines }) => [x, ...lines.map((line) => line.values)];

function last(values) {
  for (let at = values.length - 1; at >= 0; at -= 1) if (values[at] != null) return at;
  return 0;
}

function optionsOf({ look, latest, xName, yName, height, words, width, moved }) {
  const { lines } = latest.current;
  const axis = { stroke: look.soft, font: FONT, labelFont: FONT, grid: { stroke: look.line, width: 1 }, ticks: { stroke: look.line, width: 1, size: 4 }, labelGap: 2 };
  return {
    width: Math.max(200, width),
    height,
    legend: { show: false },
    cursor: { y: false, drag: { x: true, y: false }, points: { size: 7 } },
    scales: { x: { time: false, range: (_, low, high) => padded(low, high, 0.02) }, y: { range: (_, low, high) => reach(latest.current, low, high) } },
    axes: [
      { ...axis, label: xName, labelSize: 18, size: 30, grid: { show: false }, values: (_, ticks) => ticks.map((tick) => (Number.isInteger(tick) ? short(tick) : "")) },
      { ...axis, label: yName, labelSize: 18, size: 52, values: (_, ticks) => ticks.map((tick) => words(tick)) },
    ],
    series: [{}, ...lines.map((line, number) => ({
      label: line.name,
      stroke: look[`c${number % 6}`],
      width: 1.75,
      dash: dashOf(number),
      spanGaps: true,
      points: { show: line.dots ?? line.values.length < 2, size: 7, fill: look.paper },
    }))],
    hooks: {
      setCursor: [(plot) => moved(plot.cursor.idx ?? null)],
      drawClear: [(plot) => drawLevels(plot, latest.current.levels, look)],
      draw: [(plot) => drawSpans(plot, latest.current, look), (plot) => drawStars(plot, latest.current, look)],
    },
  };
}

/** From where to where: all lines, levels and spans, with some air. */
function reach({ levels, spans }, low, high) {
  const ends = [low, high, ...levels.map((level) => level.value), ...(spans ?? []).flatMap((span) => span ?? [])].filter((end) => end != null);
  return ends.length ? padded(Math.min(...ends), Math.max(...ends), 0.08) : [0, 1];
}

function padded(low, high, share) {
  const air = high > low ? (high - low) * share : Math.max(1, Math.abs(high)) * share * 5;
  return [low - air, high + air];
}

function drawLevels(plot, levels, look) {
  const { ctx, bbox } = plot;
  const scale = devicePixelRatio;
  for (const { name, value, tone } of levels) {
    const y = plot.valToPos(value, "y", true);
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = look[tone] ?? look.soft;
    ctx.lineWidth = scale;
    ctx.setLineDash([5 * scale, 4 * scale]);
    ctx.beginPath();
    ctx.moveTo(bbox.left, y);
    ctx.lineTo(bbox.left + bbox.width, y);
    ctx.stroke();
    ctx.font = `${12 * scale}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    ctx.fillText(name, bbox.left + 6 * scale, y + (value < 0 ? 14 : -6) * scale);
    ctx.restore();
  }
}

function drawSpans(plot, { x, spans }, look) {
  if (!spans) return;
  const { ctx } = plot;
  const scale = devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = look.c0;
  ctx.globalAlpha = 0.5;
  ctx.lineWidth = 1.5 * scale;
  ctx.beginPath();
  spans.forEach((span, at) => {
    if (!span) return;
    const place = plot.valToPos(x[at], "x", true);
    ctx.moveTo(place, plot.valToPos(span[0], "y", true));
    ctx.lineTo(place, plot.valToPos(span[1], "y", true));
  });
  ctx.stroke();
  ctx.restore();
}

function drawStars(plot, { x, lines, stars }, look) {
  if (!stars) return;
  const { ctx } = plot;
  const size = 6 * devicePixelRatio;
  ctx.save();
  ctx.fillStyle = look.c0;
  stars.forEach((isStar, at) => {
    const value = lines[0].values[at];
    if (!isStar || value == null) return;
    const [left, top] = [plot.valToPos(x[at], "x", true), plot.valToPos(value, "y", true)];
    ctx.beginPath();
    for (const [across, up] of [[0, -size], [size, 0], [0, size], [-size, 0]]) ctx.lineTo(left + across, top + up);
    ctx.fill();
  });
  ctx.restore();
}
