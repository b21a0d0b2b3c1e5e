"use strict";
// Add buttons that magnify a picture; a magnified picture can be moved by dragging.
for (const picture of document.querySelectorAll(".picture")) {
  const svg = picture.querySelector("svg");
  const whole = svg.viewBox.baseVal;
  const all = { x: whole.x, y: whole.y, width: whole.width, height: whole.height };
  let seen = { ...all };
  const show = (x, y, width) => {
    width = Math.min(width, all.width);
    const height = width * all.height / all.width;
    x = Math.min(Math.max(x, all.x), all.x + all.width - width);
    y = Math.min(Math.max(y, all.y), all.y + all.height - height);
    seen = { x, y, width, height };
    svg.setAttribute("viewBox", `${x} ${y} ${width} ${height}`);
    svg.style.cursor = width < all.width ? "move" : "";
    svg.style.touchAction = width < all.width ? "none" : "";
  };
  const scale = factor => {
    const width = Math.max(seen.width * factor, all.width / 32), height = width * all.height / all.width;
    show(seen.x + (seen.width - width) / 2, seen.y + (seen.height - height) / 2, width);
  };
  const buttons = document.createElement("div");
  buttons.className = "buttons";
  for (const [text, says, act] of [
    ["+", "Magnify the picture", () => scale(1 / 1.6)],
    ["\u2212", "Show more of the picture", () => scale(1.6)],
    ["all", "Show all of the picture", () => show(all.x, all.y, all.width)],
  ]) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = text;
    button.setAttribute("aria-label", says);
    button.addEventListener("click", act);
    buttons.append(button);
  }
  picture.before(buttons);
  svg.addEventListener("pointerdown", start => {
    if (seen.width >= all.width || start.target.closest("a")) return;
    const from = { ...seen }, pixels = svg.clientWidth;
    svg.setPointerCapture(start.pointerId);
    svg.onpointermove = now => show(
      from.x - (now.clientX - start.clientX) * from.width / pixels,
      from.y - (now.clientY - start.clientY) * from.width / pixels, from.width);
    svg.onpointerup = svg.onpointercancel = () => { svg.onpointermove = null; };
  });
}
