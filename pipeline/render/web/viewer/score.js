/* The time line's score: beats as ticks, the segments of a driving script as bands, and the one that plays now. */

const TICK_GAP = 5; // pixels: closer ticks are thinned out to every 2nd, 4th, 8th ...
const LABEL_ROOM = 34; // pixels: narrower bands go without words; the figure's caption says them

function segmentAt(score, time) {
  let found = null;
  for (const segment of score ? score.segments : []) if (segment[0] <= time && time < segment[1]) found = segment;
  return found;
}

const segmentText = ([, , label, kind]) => (kind === "music" ? `♪ ${label}` : label);

/* A strip over the scrub bar's way. `show(score)` fills it, `mark(time)` lights the band that plays. */
function buildStrip(duration) {
  const bands = element("div", { className: "mlv-bands" });
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
  svg.setAttribute("class", "mlv-beats");
  svg.setAttribute("preserveAspectRatio", "none");
  svg.append(path);
  const strip = element("div", { className: "mlv-strip" }, bands, svg);
  strip.setAttribute("aria-hidden", "true"); // the scrub bar speaks the time and the segment
  const share = (time) => clamp(time / Math.max(duration, 1e-6), 0, 1);
  let score = null, lit = null;
  const fit = () => {
    const beats = score ? score.beats : [], width = strip.clientWidth || 1;
    const gap = beats.length > 1 ? (share(beats[beats.length - 1]) - share(beats[0])) * width / (beats.length - 1) : width;
    let every = 1;
    while (every * gap < TICK_GAP && every < beats.length) every *= 2;
    svg.setAttribute("viewBox", `0 0 ${width} 1`);
    path.setAttribute("d", beats.filter((_, k) => k % every === 0).map((t) => `M${(share(t) * width).toFixed(1)} 0v1`).join(""));
    for (const band of bands.children) band.classList.toggle("mlv-thin", parseFloat(band.style.width) / 100 * width < LABEL_ROOM);
  };
  new ResizeObserver(fit).observe(strip);
  const show = (next) => {
    if (next === score) return;
    score = next; lit = null;
    bands.replaceChildren(...(score ? score.segments : []).map((segment) => {
      const band = element("span", { className: `mlv-band mlv-${segment[3]}`, textContent: segmentText(segment) });
      band.style.left = `${100 * share(segment[0])}%`;
      band.style.width = `${100 * (share(segment[1]) - share(segment[0]))}%`;
      return band;
    }));
    bands.hidden = !score || !score.segments.length;
    svg.style.display = score && score.beats.length ? "" : "none";
    fit();
  };
  const mark = (time) => {
    const segment = segmentAt(score, time);
    if (segment === lit) return;
    lit = segment;
    [...bands.children].forEach((band, k) => band.classList.toggle("mlv-lit", score.segments[k] === segment));
  };
  return { strip, show, mark };
}

/* The line under a figure that says what drives it now. */
function buildCaption() {
  const node = element("span", { className: "mlv-now", hidden: true });
  let shown = null;
  return {
    node,
    show(segment) {
      if (segment === shown) return;
      shown = segment;
      node.hidden = !segment;
      if (!segment) return;
      node.className = `mlv-now mlv-${segment[3]}`;
      node.textContent = segmentText(segment);
    },
  };
}
