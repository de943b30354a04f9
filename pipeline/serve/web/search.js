/* The page of `motionloom search`: asks for clips and shows them. All that is shown goes through `textContent`. */
(function () {
"use strict";

const one = (id) => document.getElementById(id);
const form = one("ask"), status = one("status"), go = one("go");
let shown = null, turn = 0;

function say(words, wrong) {
  status.textContent = words;
  status.classList.toggle("serve-wrong", Boolean(wrong));
}

async function ask(path, options) {
  const answer = await fetch(path, options).catch(() => { throw new Error("the server does not answer; is it still running?"); });
  const said = await answer.json();
  if (!answer.ok) throw new Error(said.error || `the server answered ${answer.status}`);
  return said;
}

async function find(path, body, what) {
  const mine = ++turn, began = performance.now();
  go.disabled = true;
  say("Searching…");
  try {
    const answer = await ask(path, { method: "POST", body, headers: { "Content-Type": "application/octet-stream" } });
    if (mine !== turn) return;
    if (shown) shown.remove();
    one("start").hidden = true;
    shown = window.motionloomViewer(one("viewer"), answer.viewer, { page: false });
    [...document.querySelectorAll(".mlv-cell")].forEach((cell, k) => {
      const more = Object.assign(document.createElement("button"), { type: "button", textContent: "More like this" });
      more.addEventListener("click", () => find("/api/search", JSON.stringify({ like: answer.found[k] }), answer.found[k]));
      cell.append(Object.assign(document.createElement("p"), { className: "serve-save" }));
      cell.lastChild.append(more);
    });
    say(`Nearest to ${what}, in ${((performance.now() - began) / 1000).toFixed(2)} s; the number is the cosine`);
  } catch (error) {
    if (mine === turn) say(error.message, true);
  } finally {
    if (mine === turn) go.disabled = false;
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  const words = one("words").value.trim();
  find("/api/search", JSON.stringify({ words }), `“${words}”`);
});
for (const name of ["dragover", "drop", "dragleave"]) {
  document.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.toggle("serve-over", name === "dragover");
    if (name === "drop" && event.dataTransfer.files.length) find("/api/like", event.dataTransfer.files[0], event.dataTransfer.files[0].name);
  });
}

ask("/api/info").then((info) => {
  document.title = `${info.name} · motionloom search`;
  say(`${info.name}: ${info.clips} clips`);
}, (error) => say(error.message, true));
})();
