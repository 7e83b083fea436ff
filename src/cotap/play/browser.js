// What the page adds to viser's own: keys and a gamepad that drive, and links that hold settings. It opens no connection: what it has to say, it
// types into a box of the page, as a hand would. BOXES, names of boxes by what they are for, is put before this text.
if (window.cotap) window.cotap.abort(); // the page has connected anew
window.cotap = new AbortController();
const signal = window.cotap.signal;

const AXES = { // forward, left, turn to the left
  KeyW: [1, 0, 0], KeyS: [-1, 0, 0], KeyA: [0, 1, 0], KeyD: [0, -1, 0], KeyQ: [0, 0, 1], KeyE: [0, 0, -1],
};
const HALF = 0.5; // of the largest velocity; all of it with the shift key
const DEAD = 0.15; // a stick at rest is not quite at zero
const EVERY_MS = 100;

const style = document.createElement("style");
style.textContent = Object.values(BOXES)
  .map((box) => `div:has(> div > div > p > label[for="${box}"]) { display: none }`).join("\n");
document.head.append(style);
signal.addEventListener("abort", () => style.remove());

function find(box) {
  let at = document.querySelector(`label[for="${box}"]`);
  while (at && !at.querySelector("input")) at = at.parentElement;
  return at && at.querySelector("input");
}

function type(box, text) {
  const input = find(box);
  if (!input) return false;
  Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, text); // past React's own
  return input.dispatchEvent(new Event("input", { bubbles: true }));
}

const held = new Set();
let fast = false, moving = false, count = Date.now(); // the same text twice would be no change

function say(axes, stand) {
  moving = axes.some((a) => a !== 0);
  type(BOXES.drive, [...axes.map((a) => Math.max(-1, Math.min(1, a)).toFixed(3)), Number(stand), ++count].join(" "));
}

function keys() {
  const sum = [0, 0, 0];
  for (const key of held) AXES[key].forEach((a, i) => { sum[i] += a * (fast ? 1 : HALF); });
  return sum;
}

function pad() { // a browser may have none, or hide it from pages that are not served by this machine
  const found = [...(navigator.getGamepads?.() ?? [])].find((p) => p && p.connected && p.axes.length >= 2);
  if (!found) return { axes: [0, 0, 0], stand: false };
  const stick = (i) => (Math.abs(found.axes[i] ?? 0) < DEAD ? 0 : -found.axes[i]);
  return { axes: [stick(1), stick(0), stick(2)], stand: Boolean(found.buttons[0]?.pressed) };
}

function tell() { // again and again while something is held: who falls silent lets go
  const { axes, stand } = pad();
  if (stand) held.clear();
  const sum = keys().map((a, i) => a + axes[i]);
  if (stand || moving || sum.some((a) => a !== 0)) say(stand ? [0, 0, 0] : sum, stand);
}

function typing(element) {
  if (element.isContentEditable || element.tagName === "TEXTAREA") return true;
  return element.tagName === "INPUT" && !["checkbox", "radio", "range", "button"].includes(element.type);
}

function down(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || typing(event.target)) return;
  fast = event.shiftKey;
  if (event.code in AXES) {
    event.stopPropagation(); // viser moves the camera with the same keys; the arrow keys still turn it
    if (event.repeat) return;
    held.add(event.code);
    event.target.blur?.(); // so that space is not the button that was pressed last
    tell();
  } else if (event.code === "Space" && !event.target.matches?.(":focus-visible")) { // no button reached by the tab key
    event.preventDefault();
    event.target.blur?.();
    held.clear();
    say([0, 0, 0], true);
  }
}

function up(event) {
  fast = event.shiftKey;
  if (held.delete(event.code)) tell();
}

function letGo() {
  held.clear();
  tell();
}

window.addEventListener("keydown", down, { capture: true, signal });
window.addEventListener("keyup", up, { capture: true, signal });
window.addEventListener("blur", letGo, { signal });
const timer = setInterval(tell, EVERY_MS);
signal.addEventListener("abort", () => clearInterval(timer));

const AGAIN_MS = 500;
window.cotapLink ??= new URLSearchParams(location.search).get("set") ?? ""; // once, not whenever the page connects

let typed = 0;
const linking = setInterval(() => { // again and again, as it may not be heard at first; the page empties the box
  if (typed && find(BOXES.link)?.value === "") window.cotapLink = "";
  if (!window.cotapLink) clearInterval(linking);
  else if (type(BOXES.link, window.cotapLink + " ".repeat(typed % 2))) typed += 1;
}, AGAIN_MS);
signal.addEventListener("abort", () => clearInterval(linking));

document.addEventListener("click", (event) => { // without a clipboard it opens, and can be copied from there
  const link = event.target.closest?.('a[href^="?set="]');
  if (!link || !navigator.clipboard) return;
  event.preventDefault();
  navigator.clipboard.writeText(link.href);
  history.replaceState(null, "", link.href);
}, { signal });
