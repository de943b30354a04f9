/* The motion that is shown, on the user's own character (`serve --rig`). */

import "./rig.js";

const one = (id) => document.getElementById(id);

/* The part of a page (`serve.js`). */
export function begin(page) {
  const section = one("character"), show = one("character-show"), save = one("character-save");
  const plain = { opened: false, able: false, tell() {}, take: () => false, refresh() {} };
  if (!page.info.character.possible) {
    section.remove();
    save.remove();
    return plain;
  }
  let drawn = null; // what the page saves, of which the character shows the motion

  async function refresh() {
    const asked = page.asked;
    save.hidden = !asked;
    if (section.hidden || !asked || asked === drawn) return;
    drawn = asked;
    try {
      const answer = await page.post(asked.path, { ...asked.body, format: "rig-page" });
      const [, data] = /<script type="application\/json" id="data">([^<]*)</.exec(await answer.text()); // it holds no `<`
      if (drawn === asked) await window.motionloomRig(section, JSON.parse(data));
    } catch (error) {
      page.say(error.message, true);
    }
  }

  show.addEventListener("click", () => {
    section.hidden = !section.hidden;
    show.setAttribute("aria-pressed", String(!section.hidden));
    refresh();
    section.scrollIntoView({ block: "nearest" });
  });
  for (const button of save.querySelectorAll("[data-kind]")) button.addEventListener("click", () => page.keep(button.dataset.kind));
  return { ...plain, refresh };
}
