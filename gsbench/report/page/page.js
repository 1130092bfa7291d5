"use strict";
// Tabs, a legend that hides models, the card that names a run, the slider between images, and reloading of a live page.
const each = (selector, act, root = document) => root.querySelectorAll(selector).forEach(act);

each(".tabs", (tabs) => {
  const buttons = [...tabs.querySelectorAll("[role=tab]")];
  const panels = buttons.map((b) => document.getElementById(b.getAttribute("aria-controls")));
  const kept = "tab " + location.pathname + tabs.closest("section").id;
  const select = (chosen, focus) => {
    buttons.forEach((b, i) => {
      b.setAttribute("aria-selected", i === chosen);
      b.tabIndex = i === chosen ? 0 : -1;
      panels[i].hidden = i !== chosen;
    });
    if (focus) buttons[chosen].focus();
    try { sessionStorage.setItem(kept, chosen); } catch { /* storage may be forbidden for files */ }
  };
  buttons.forEach((b, i) => {
    b.addEventListener("click", () => select(i, false));
    b.addEventListener("keydown", (event) => {
      const to = { ArrowRight: i + 1, ArrowLeft: i - 1, Home: 0, End: buttons.length - 1 }[event.key];
      if (to === undefined) return;
      event.preventDefault();
      select((to + buttons.length) % buttons.length, true);
    });
  });
  let before = 0;
  try { before = Number(sessionStorage.getItem(kept)) || 0; } catch { /* as above */ }
  select(before < buttons.length ? before : 0, false);
});

each("button.model", (button) => {
  const { colour } = button.dataset;
  const article = button.closest("article");
  button.addEventListener("click", () => { // a hidden model's colour is transparent, and its points have no card
    const shown = button.getAttribute("aria-pressed") !== "true";
    each(`button.model[data-colour="${colour}"]`, (same) => {
      same.setAttribute("aria-pressed", shown);
      const { style } = same.closest("section");
      if (shown) style.removeProperty("--model-" + colour);
      else style.setProperty("--model-" + colour, "transparent");
    }, article);
    each(`.hit[data-colour="${colour}"]`, (hit) => { hit.style.display = shown ? "" : "none"; }, article);
  });
});

const runs = JSON.parse(document.getElementById("runs").textContent);
const card = document.getElementById("card");
let pinned = null;
const show = (hit) => {
  const run = runs[hit.dataset.run];
  card.querySelector(".name").textContent = run.name;
  card.querySelector(".facts").textContent = run.facts;
  card.querySelector("code").textContent = run.command;
  card.querySelector("code").hidden = !run.command;
  card.hidden = false;
  const at = hit.getBoundingClientRect();
  const box = card.getBoundingClientRect();
  const left = Math.min(Math.max(12, at.left + at.width / 2 - box.width / 2), innerWidth - box.width - 12);
  const above = at.top - box.height - 8;
  card.style.transform = `translate(${left}px, ${above > 8 ? above : at.bottom + 8}px)`;
  each(".hit.on", (other) => other.classList.remove("on"));
  hit.classList.add("on");
};
const hide = () => {
  pinned = null;
  card.hidden = true;
  each(".hit.on", (other) => other.classList.remove("on"));
};
document.addEventListener("pointerover", (event) => {
  if (event.target.matches(".hit") && !pinned) show(event.target);
});
document.addEventListener("pointerout", (event) => {
  if (event.target.matches(".hit") && !pinned) hide();
});
document.addEventListener("click", (event) => { // a click keeps the card, so that its text can be selected
  if (event.target.matches(".hit")) { show(event.target); pinned = event.target; } else if (!card.contains(event.target)) hide();
});
document.addEventListener("keydown", (event) => { if (event.key === "Escape") hide(); });
document.addEventListener("scroll", () => { if (!card.hidden) hide(); }, { passive: true });

each(".compare", (root) => {
  const views = JSON.parse(document.getElementById(root.dataset.views).textContent);
  const part = (name) => root.querySelector("." + name);
  const fill = (select, options, chosen) => {
    select.replaceChildren(...options.map(([value, text]) => new Option(text, value)));
    if (options.some(([value]) => value === chosen)) select.value = chosen;
  };
  const source = (view, choice) => {
    const [kind, model] = choice.split(":");
    return kind === "truth" ? view.truth : view[kind][model];
  };
  const draw = () => {
    const view = views[part("view").value];
    const [left, right] = [part("left"), part("right")];
    part("over").src = source(view, left.value);
    part("under").src = source(view, right.value);
    root.querySelector(".stage").style.aspectRatio = `${view.width} / ${view.height}`;
    for (const [side, image] of [["left", "over"], ["right", "under"]]) {
      const text = part(side).selectedOptions[0].textContent;
      const score = view.scores[part(side).value.split(":")[1]];
      part(side + "-name").textContent = score ? `${text}: ${score}` : text;
      part(image).alt = `${text} of ${view.scene}, ${view.name}`;
    }
  };
  const change = () => {
    const view = views[part("view").value];
    const models = Object.keys(view.render);
    const options = [["truth:", "ground truth"], ...models.map((m) => ["render:" + m, m]), ...models.map((m) => ["error:" + m, m + ", error"])];
    const [left, right] = [part("left").value, part("right").value];
    const best = models.includes(root.dataset.best) ? root.dataset.best : models[models.length - 1];
    fill(part("left"), options, left || "render:" + best);
    fill(part("right"), options, right || "truth:");
    draw();
  };
  fill(part("view"), views.map((v, i) => [String(i), `${v.scene}, ${v.name}`]), "0");
  part("view").addEventListener("change", change);
  part("left").addEventListener("change", draw);
  part("right").addEventListener("change", draw);
  const slider = root.querySelector("input");
  const move = () => root.style.setProperty("--share", slider.value + "%");
  slider.addEventListener("input", move);
  move();
  change();
});

const wait = Number(document.body.dataset.reload);
if (wait) {
  setInterval(() => {
    const busy = !getSelection().isCollapsed || pinned || document.activeElement.matches("select, input");
    if (!busy && !document.hidden) location.reload();
  }, wait * 1000);
}
