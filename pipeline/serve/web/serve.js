/* The page of `motionloom serve`: asks for a motion and shows it. Everything that is shown goes through `textContent`.

   A package's part of the page (`info.parts`) is a script of its name that exports `begin(page)`. `page` gives it `info` and
   the functions below; `page.current` is what is shown: `{ ref, viewer, frames, caption, name }`, `ref` being what the server
   knows it by, and `saved` where it can be saved. `begin` returns what the page asks of the part: `opened`, whether it has
   taken the page over, and then `tell(words, wrong)` instead of the status line; `able`, whether files can be dropped on it;
   `take(file, alone)`, which takes such a file or says false, `alone` where nothing else would; `refresh()`, called when what
   can be saved has changed. */

const one = (id) => document.getElementById(id);
const form = one("ask"), status = one("status"), go = one("go"), save = one("save");
const notes = one("notes"), start = one("start"), parts = [];
let info = null, shown = null, asked = null, music = null, turn = 0, current = null;

/* A node with properties and children. */
export function element(tag, properties, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

const opened = () => parts.find((part) => part.opened);

function say(words, wrong) {
  if (opened()) opened().tell(words, wrong);
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
  if (music && one("beats").value) body.beats = one("beats").value;
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
  note(answer.heard ? [`Music: ${answer.heard}`, ...answer.notes] : answer.notes, answer.nearest);
}

/* What the buttons save; nothing hides them. */
function savable(what) {
  asked = what;
  save.hidden = !what && !(current && !opened());
  save.firstElementChild.hidden = !what;
  one("save-words").textContent = opened() ? "Save the result as" : "Save as";
  for (const part of parts) part.refresh();
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

async function take(file) {
  music = file ? await send("/api/sounds", file, info.limits.sound_bytes, `Sending ${file.name}…`) : null;
  one("beats").value = "";
  one("beats-field").hidden = !music;
  if (music) say(`${file.name}: ${music.seconds.toFixed(1)} s of music`);
}

form.addEventListener("submit", (event) => { event.preventDefault(); generate(); });
for (const button of save.querySelectorAll("[data-format]")) button.addEventListener("click", () => keep(button.dataset.format));
one("beats").addEventListener("change", generate); // the same dance to other beats
one("sound").addEventListener("change", () => take(one("sound").files[0]));
for (const name of ["dragover", "drop", "dragleave"]) {
  document.addEventListener(name, (event) => {
    if (!info || !(info.modalities.includes("audio") || parts.some((part) => part.able))) return;
    event.preventDefault();
    document.body.classList.toggle("serve-over", name === "dragover");
    if (name !== "drop" || !event.dataTransfer.files.length) return;
    const [file] = event.dataTransfer.files;
    const sounds = info.modalities.includes("audio");
    if (!parts.some((part) => part.take(file, !sounds)) && sounds) {
      one("sound").files = event.dataTransfer.files;
      take(file);
    }
  });
}

const page = {
  say, post, send, mount, note, savable, keep,
  get info() { return info; },
  /* What the buttons save: `{ path, body }` of a request; null where nothing is. */
  get asked() { return asked; },
  get current() { return current; },
  set current(clip) { current = clip; },
  get turn() { return turn; },
  /* Begins a request, of which the newest alone is shown; its number is `turn` until another begins. */
  next: () => (turn += 1),
  show: (clip) => { current = clip; mount(clip.viewer); savable(clip.saved); },
};

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
  for (const node of document.querySelectorAll("[data-in]")) one(node.dataset.in).append(node);
  for (const name of info.parts) parts.push((await import(`./${name}.js`)).begin(page));
  one("start-words").textContent = info.examples.length ? "It knows, for example:" : "What you ask for is shown here.";
  one("start-examples").replaceChildren(...choices(info.examples));
  start.hidden = Boolean(shown); // who was quick sees a motion already
  one("credits").textContent = info.credits.join(" ");
  if (!matchMedia("(pointer: coarse)").matches) one("caption").focus(); // a phone would open its keyboard over the page
})();
