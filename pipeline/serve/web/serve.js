/* The page of `motionloom serve`: asks for a motion and shows it. Everything that is shown goes through `textContent`. */

import { makeEditor } from "./edit.js";
import { element } from "./lanes.js";

const one = (id) => document.getElementById(id);
const form = one("ask"), status = one("status"), go = one("go"), save = one("save");
const notes = one("notes"), start = one("start"), CLIP = /\.(npz|bvh|glb)$/i;
let info = null, shown = null, asked = null, music = null, turn = 0;
let editor = null, current = null; // what is shown, as the editor takes it

function say(words, wrong) {
  if (editor && editor.opened) editor.tell(words, wrong);
  status.textContent = words;
  status.classList.toggle("serve-wrong", Boolean(wrong));
}

/* The answer's JSON; what a server refuses, or a network that fails, becomes an error of one sentence. */
async function ask(path, options) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch (error) {
    throw new Error("the server does not answer; is it still running?");
  }
  if (!answer.ok) {
    let words = `the server answered ${answer.status}`;
    try { words = (await answer.json()).error || words; } catch (error) { /* no sentence in it */ }
    throw new Error(words);
  }
  return answer;
}

const post = (path, body, signal) => ask(path, { signal, method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });

/* What the model draws with where nothing is asked for. */
const usualGuidance = () => info.sampling.cfg_scale || 1;

function wanted() {
  const body = { caption: one("caption").value.trim(), seed: Number(one("seed").value) || 0 };
  if (one("seconds").value) body.seconds = Number(one("seconds").value);
  const guidance = Number(one("cfg_scale").value);
  if (guidance && guidance !== usualGuidance()) body.cfg_scale = guidance;
  if (info.face && one("face").value.trim()) body.face = one("face").value.trim();
  if (music) body.sound = music.sound;
  return body;
}

async function generate() {
  const mine = ++turn, body = { ...wanted(), format: "viewer" };
  if (!body.caption && !body.sound) {
    say(info.modalities.includes("audio") ? "Say what the person does, or choose music." : "Say what the person does.", true);
    one("caption").focus();
    return;
  }
  go.disabled = true;
  say("Generating…");
  const began = performance.now();
  try {
    const answer = await (await post("/api/generate", body)).json();
    if (mine !== turn) return;
    show(answer, body);
    say(`${answer.seconds.toFixed(1)} s of motion, made in ${((performance.now() - began) / 1000).toFixed(1)} s, seed ${answer.seed}`);
  } catch (error) {
    if (mine === turn) say(error.message, true);
  } finally {
    if (mine === turn) go.disabled = false;
  }
}

function mount(data, over) {
  if (shown) shown.remove();
  start.hidden = true;
  shown = window.motionloomViewer(one("viewer"), data, { page: false, over });
  return shown;
}

function show(answer, body) {
  mount(answer.viewer);
  const saved = { path: "/api/generate", body };
  savable(saved);
  current = { ref: answer.clip, saved, viewer: answer.viewer, frames: answer.frames, caption: answer.caption, name: answer.caption || "a dance" };
  note(answer.notes, answer.nearest);
}

/* What the buttons save; nothing hides them. */
function savable(what) {
  asked = what;
  save.hidden = !what && !(current && !editor.opened);
  save.firstElementChild.hidden = !what;
  one("save-words").textContent = editor.opened ? "Save the result as" : "Save as";
  one("change").hidden = editor.opened || !info.edit.possible;
}

/* Captions to be clicked. */
const choices = (captions) => captions.map((caption) => element("button", {
  type: "button", textContent: caption, onclick: () => { one("caption").value = caption; generate(); },
}));

function note(lines, captions) {
  notes.replaceChildren(...lines.map((words) => element("p", { textContent: words })), ...choices(captions));
  notes.hidden = !notes.children.length;
}

async function keep(format) {
  try {
    const answer = await post(asked.path, { ...asked.body, format });
    const name = /filename\*=UTF-8''(.+)/.exec(answer.headers.get("content-disposition") || "");
    const address = URL.createObjectURL(await answer.blob());
    const link = element("a", { href: address, download: name ? decodeURIComponent(name[1]) : `motion.${format}` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(address), 10000);
    say(`Saved ${link.download}`);
  } catch (error) {
    say(error.message, true);
  }
}

/* What the server answers to a file; null where it is too large, or refused. */
async function send(path, file, most, words) {
  if (file.size > most) {
    say(`${file.name} is too large: at most ${Math.round(most / 2 ** 20)} MB`, true);
    return null;
  }
  say(words);
  try {
    return await (await ask(path, { method: "POST", headers: { "Content-Type": "application/octet-stream" }, body: file })).json();
  } catch (error) {
    say(error.message, true);
    return null;
  }
}

/* A motion file, to be changed. */
async function takeClip(file) {
  const mine = ++turn, answer = await send("/api/clips", file, info.limits.clip_bytes, `Reading ${file.name}…`);
  if (!answer || mine !== turn) return;
  current = { ref: answer.clip, viewer: answer.viewer, frames: answer.frames, caption: answer.caption, name: file.name };
  note(answer.notes, []);
  say(`${file.name}: ${answer.seconds.toFixed(1)} s of motion`);
  editor.open(current);
}

async function take(file) {
  music = file ? await send("/api/sounds", file, info.limits.sound_bytes, `Sending ${file.name}…`) : null;
  if (music) say(`${file.name}: ${music.seconds.toFixed(1)} s of music`);
}

form.addEventListener("submit", (event) => { event.preventDefault(); generate(); });
for (const button of save.querySelectorAll("[data-format]")) button.addEventListener("click", () => keep(button.dataset.format));
one("change").addEventListener("click", () => { note([], []); editor.open(current); });
one("sound").addEventListener("change", () => take(one("sound").files[0]));
one("clip").addEventListener("change", () => { if (one("clip").files.length) takeClip(one("clip").files[0]); });
for (const name of ["dragover", "drop", "dragleave"]) {
  document.addEventListener(name, (event) => {
    if (!info || !(info.modalities.includes("audio") || info.edit.possible)) return;
    event.preventDefault();
    document.body.classList.toggle("serve-over", name === "dragover");
    if (name !== "drop" || !event.dataTransfer.files.length) return;
    const [file] = event.dataTransfer.files;
    if (CLIP.test(file.name) || !info.modalities.includes("audio")) dropClip(file);
    else {
      one("sound").files = event.dataTransfer.files;
      take(file);
    }
  });
}

function dropClip(file) {
  if (!info.edit.possible) say(`${file.name}: ${info.edit.why}`, true);
  else if (!CLIP.test(file.name)) say(`${file.name} is no motion that can be read here: drop a BVH, GLB or npz file`, true);
  else takeClip(file);
}

one("more").open = window.innerWidth > 620 && window.innerHeight > 500;

(async () => {
  try {
    info = await (await ask("/api/info")).json();
  } catch (error) {
    say(error.message, true);
    return;
  }
  document.title = `${info.model} · motionloom`;
  one("caption").maxLength = one("face").maxLength = info.limits.caption;
  one("cfg_scale").value = usualGuidance();
  one("seconds").max = info.limits.seconds;
  one("face-field").hidden = !info.face;
  one("caption-field").hidden = !info.modalities.includes("text");
  one("sound-field").hidden = !info.modalities.includes("audio");
  const drivers = info.modalities.map((name) => (name === "audio" ? "music" : name)).join(" or ");
  say(`${info.model}: ${drivers} to motion, at most ${info.limits.seconds} s`);
  editor = makeEditor({
    info, post, mount,
    savable,
    closed: (clip) => {
      current = clip;
      mount(clip.viewer);
      savable(clip.saved);
    },
  });
  for (const node of document.querySelectorAll(".edit-can")) node.hidden = !info.edit.possible;
  one("change-not").hidden = info.edit.possible;
  one("change-not").textContent = info.edit.why;
  one("start-words").textContent = info.examples.length ? "It knows, for example:" : "What you ask for is shown here.";
  one("start-examples").replaceChildren(...choices(info.examples));
  start.hidden = false;
  one("credits").textContent = info.credits.join(" ");
  if (!matchMedia("(pointer: coarse)").matches) one("caption").focus(); // a phone would open its keyboard over the page
})();
