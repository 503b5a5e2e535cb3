// A page that somebody was sent: the picture and its motion, and everything else behind one small button.
import { tilt } from "./tilt.js";

const TAP_MS = 300; // two taps within this time are a double tap
const TAP_PIXELS = 12; // a finger that moves farther drags
const ICONS = '<svg class="close" viewBox="0 0 24 24" aria-hidden="true"><path d="M6.5 6.5l11 11M17.5 6.5l-11 11"/></svg>'
  + '<svg class="sliders" viewBox="0 0 24 24" aria-hidden="true"><path d="M4 7h10M18 7h2M4 17h2M10 17h10"/><circle cx="16" cy="7" r="2.2"/><circle cx="8" cy="17" r="2.2"/></svg>';

// What the tools are called here, for somebody who knows nothing of the program; the ids of their buttons.
const WORDS = {
  heat: "Show what was filled in", compare: "Before and after", shot: "Save a picture", record: "Save a video",
  reset: "Back to the start", full: "Full screen",
};
const PATHS = { swipe: "Side to side", shake: "Sway", rotate: "Circle", "rotate-forward": "Forward" };

/** Prepare the page of a file. Its scene is shown afterwards. */
export function gift(viewer) {
  document.body.classList.add("gift");
  words();
  backdrop();
  caption();
  corner();
  taps(viewer);
  tilt(viewer);
}

/** The photo, blurred, fills what the picture leaves of the window. */
function backdrop() {
  const photo = document.getElementById("photo");
  if (!photo.src) return;
  document.body.prepend(Object.assign(new Image(), { id: "backdrop", alt: "", src: photo.src }));
  document.getElementById("frame").hidden = false; // the photo stands there until the scene is drawn
  document.getElementById("frame").classList.add("waiting");
}

/** What the sender wrote, below the picture. */
function caption() {
  const text = document.querySelector('meta[property="og:description"]')?.content;
  if (text) document.getElementById("area").after(Object.assign(document.createElement("p"), { id: "caption", textContent: text }));
}

/** Whether this is a page that somebody was sent, who need not know the program's words. */
export function isGift() {
  return document.body.classList.contains("gift");
}

/** Plain words on the tools, which are also what a screen reader says. */
function words() {
  for (const [id, text] of Object.entries(WORDS)) {
    const button = document.getElementById(id);
    button.querySelector("span").textContent = text;
    button.removeAttribute("aria-label");
  }
  for (const button of document.getElementById("paths").children) button.textContent = PATHS[button.dataset.kind];
  document.querySelector("#disparity").previousElementSibling.textContent = "How far it moves";
}

/** The button that shows the tools, and hides them again. */
function corner() {
  const button = Object.assign(document.createElement("button"), { type: "button", id: "corner", innerHTML: ICONS });
  const open = (on) => {
    document.body.classList.toggle("tools", on);
    button.setAttribute("aria-expanded", on);
    button.setAttribute("aria-label", on ? "Hide the tools" : "Tools");
    button.title = on ? "Hide the tools (Esc)" : "Tools: save a picture or a video, compare, and more";
  };
  button.onclick = () => open(!document.body.classList.contains("tools"));
  addEventListener("keydown", ({ key }) => key === "Escape" && open(false));
  open(false);
  // Who has a headset shall see it without looking for it.
  document.body.append(document.getElementById("vr"), button);
}

/** A tap lets the picture move or stand, and a second one soon after it shows the photo's own view. */
function taps(viewer) {
  const { canvas } = viewer;
  let down = null;
  let lastTap = -Infinity; // when the finger touched, by the clock of the events, which a slow page does not delay
  canvas.addEventListener("pointerdown", (event) => (down = event.isPrimary ? event : null));
  canvas.addEventListener("pointerup", (event) => {
    const isTap = down && Math.hypot(event.clientX - down.clientX, event.clientY - down.clientY) < TAP_PIXELS;
    const isSecond = isTap && down.timeStamp - lastTap < TAP_MS;
    if (isTap) lastTap = isSecond ? -Infinity : down.timeStamp;
    down = null;
    if (!isTap || !viewer.description || event.button) return;
    if (isSecond) viewer.home();
    else if (viewer.playing) viewer.pause();
    else viewer.play();
  });
}
