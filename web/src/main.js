// Starts the page: finds a scene, shows it, and takes further photos where there is a server.
import { control } from "./controls.js";
import { cameraAt, Edits } from "./edits.js";
import { divider, fit, panel, roomy, unfold } from "./panel.js";
import * as source from "./source.js";
import { KINDS, Viewer } from "./viewer.js";
import { eyeOnPath, lookingAxes } from "./views.js";

const STAGES = {
  load: "Loading", prepare: "Reading the depth map", base: "Finding depth", complete: "Filling what the photo hides",
  "fill-seen": "Filling the holes that you have seen", remove: "Taking it out", patch: "Filling what it hid",
  write: "Almost there", measure: "Almost there", page: "Almost there",
};
const BASES = { auto: "the best that is here", sharp: "SHARP", moge: "MoGe-2", depth: "Depth Anything", lite: "lite: quick, and rough" };
const element = (id) => document.getElementById(id);
const viewer = started();
let upload = null; // what the server takes, where there is one
let working = null; // the scene that is waited for
let edits = null;

if (viewer) {
  control(viewer.canvas, viewer);
  panel(viewer, say);
  divider(viewer);
  uploads();
  edits = new Edits(viewer, { say, progress, begin: (id) => (working = id), end });
  const ready = first();
  ready.catch((error) => notice("Nothing to show", error.message));
  window.spackle = scripting(ready);
}

function started() {
  const canvas = element("view");
  try {
    canvas.addEventListener("webglcontextlost", () => notice("The graphics stopped", "Reload the page to go on."));
    return new Viewer(canvas);
  } catch (error) {
    const missing = !document.createElement("canvas").getContext("webgl2");
    notice("This page needs WebGL 2", missing ? "Your browser does not offer it here: another browser, or hardware acceleration in its settings, will help." : error.message);
    return null;
  }
}

async function first() {
  const own = await source.embedded();
  if (own) return show(own);
  ({ upload } = await source.current());
  element("open").hidden = !upload;
  edits.allowed = Boolean(upload);
  if (upload) element("file").accept = ["image/*", ...upload.suffixes].join(",");
  const bases = (upload?.bases ?? []).map((name) => new Option(BASES[name] ?? name, name));
  element("choices").querySelector("[name=base]").replaceChildren(...bases);
  addEventListener("hashchange", () => chosen() && chosen() !== viewer.id && watch(chosen()));
  if (chosen()) return watch(chosen());
  for (const button of document.querySelectorAll("[data-example]")) button.firstChild.src = source.here(`/${button.dataset.example}`);
  notice("Step into your photo", upload ? `${matchMedia("(hover: hover)").matches ? "Drop a photo here, or choose one" : "Choose a photo"}, and look behind what stands in front.` : "The address names no scene.");
  element("notice").classList.add("empty");
}

/** The scene that the address names. */
function chosen() {
  return /^#([0-9a-f]{16})$/.exec(location.hash)?.[1];
}

async function show({ description, layers }, id = null) {
  viewer.show(description, layers, id);
  element("name").textContent = description.name;
  document.title = `${description.name} · Spackle`;
  element("frame").hidden = false;
  element("frame").classList.add("waiting");
  document.body.classList.remove("idle");
  fit(viewer);
  if (roomy()) unfold(true);
  await viewer.stage.settled();
  element("frame").classList.remove("waiting");
  element("notice").hidden = true;
  element("download").hidden = !id;
  await edits.shown(id);
  if (description.note) say(description.note);
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) viewer.play();
}

/** Follow a photo to its scene; the photo stands in its place meanwhile. */
async function watch(id) {
  working = id;
  viewer.playing = false; // the processor is needed elsewhere
  if (chosen() !== id) history.replaceState(null, "", `#${id}`); // else what can be done again stays
  progress(null, null);
  try {
    if (!stand.url && (await source.state(id)).files.includes("photo.jpg")) stand(source.file(id, "photo.jpg"));
    await source.follow(id, ({ stage, share }) => progress(stage, share));
    await show(await source.load(id, (share) => progress("load", share)), id);
  } catch (error) {
    failed(error);
  }
  working = null;
  stand(null);
}

/** The work on a scene that is shown is over. */
function end() {
  working = null;
  element("notice").hidden = true;
}

/** Show a picture until the scene is there. */
function stand(url) {
  const photo = element("photo");
  if (stand.url?.startsWith("blob:")) URL.revokeObjectURL(stand.url);
  stand.url = url;
  if (!url) return;
  photo.onload = () => {
    element("frame").hidden = false;
    element("frame").classList.add("waiting");
    fit(viewer, { width: photo.naturalWidth, height: photo.naturalHeight });
  };
  photo.onerror = () => url.startsWith("blob:") && /^[0-9a-f]{16}$/.test(working) && stand(source.file(working, "photo.jpg"));
  photo.src = url;
}

async function open(photo) {
  if (!photo || working) return;
  // What the file is, the server sees in its content; only what is surely no photo stays here.
  if (/^(video|audio|text)\//.test(photo.type)) return say(`${photo.name}: not a photo`);
  if (photo.size > upload.max_bytes) return say(`${photo.name} is larger than ${Math.floor(upload.max_bytes / 2 ** 20)} MB`);
  working = "…";
  stand(URL.createObjectURL(photo));
  progress(null, null);
  try {
    await watch(await source.send(photo, choices()));
  } catch (error) {
    failed(error);
  }
  working = null;
  stand(null);
}

function uploads() {
  const file = element("file");
  const dialog = element("choices");
  const start = element("start");
  for (const button of document.querySelectorAll("[data-do=open]")) button.onclick = () => dialog.showModal();
  for (const button of document.querySelectorAll("[data-example]")) button.onclick = () => example(button.dataset.example);
  element("stop").onclick = () => source.remove(working).catch((error) => say(error.message));
  file.onchange = () => {
    start.disabled = !file.files[0];
    if (!dialog.open) take();
  };
  start.onclick = take;
  const elements = dialog.querySelector("form").elements;
  elements.depth.onchange = elements.depth_kind.onchange = offerReadings;
  const holdsFile = (event) => upload && !working && event.dataTransfer?.types.includes("Files");
  addEventListener("dragover", (event) => {
    event.preventDefault();
    if (holdsFile(event)) document.body.classList.add("dropping");
  });
  addEventListener("dragleave", (event) => event.relatedTarget || document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    if (!holdsFile(event)) return;
    if (dialog.open) dialog.close();
    open(event.dataTransfer.files[0]);
  });

  function take() {
    dialog.close();
    open(file.files[0]);
    file.value = "";
    start.disabled = true;
  }
}

/** One of the photos that come with the page. */
async function example(name) {
  const photo = await (await fetch(source.here(`/${name}`))).blob();
  open(new File([photo], name, { type: photo.type }));
}

/** Show how a depth map may be read: its kind, and for distances the unit. */
function offerReadings() {
  const { depth, depth_kind: kind } = element("choices").querySelector("form").elements;
  element("kind").hidden = !depth.files[0];
  element("unit").hidden = !depth.files[0] || !["", "metric"].includes(kind.value);
}

/** What the dialog says: {base, disparity, depth, depth_kind, depth_unit}. */
function choices() {
  const form = element("choices").querySelector("form");
  const said = Object.fromEntries(new FormData(form));
  form.elements.depth.value = ""; // it is of one photo
  if (element("unit").hidden) said.depth_unit = "";
  offerReadings();
  return said;
}

function notice(title, text, busy = false) {
  const box = element("notice");
  box.hidden = false;
  box.classList.remove("empty");
  box.classList.toggle("busy", busy);
  box.classList.toggle("may-open", !busy && Boolean(upload));
  box.classList.toggle("may-stop", busy && Boolean(upload) && /^[0-9a-f]{16}$/.test(working));
  box.querySelector("h2").textContent = title;
  box.querySelector("p").textContent = text;
}

/** `share` in 0..1, or null where nobody knows. */
function progress(stage, share) {
  notice(STAGES[stage] ?? stage ?? "Working on your photo", "", true);
  const bar = element("notice").querySelector("progress");
  if (share === null) bar.removeAttribute("value");
  else bar.value = share;
}

function failed(error) {
  element("frame").classList.remove("waiting");
  if (viewer.description) {
    history.replaceState(null, "", `#${viewer.id ?? ""}`);
    element("notice").hidden = true;
    fit(viewer);
    say(error.message);
  } else {
    element("frame").hidden = true;
    notice("That did not work", error.message);
  }
}

function say(text, stay = false) {
  const toast = element("toast");
  clearTimeout(say.timer);
  toast.classList.toggle("shown", Boolean(text));
  if (!text) return;
  toast.textContent = text;
  if (!stay) say.timer = setTimeout(() => toast.classList.remove("shown"), 6000);
}

/** For tests and for scripts in the console. Everything that changes the view resolves when it is drawn. */
function scripting(ready) {
  const drawn = (change) => {
    change();
    viewer.drawnElsewhere();
    return viewer.stage.settled();
  };
  return {
    ready, // resolves when the first scene is drawn
    kinds: KINDS,
    get description() {
      return viewer.description;
    },
    get id() {
      return viewer.id;
    },
    /** The present view as the server takes it, for what is filled. */
    camera: () => cameraAt(viewer.description, viewer.stage.eye, viewer.stage.zoom),
    seen: () => edits.seen.withPresent(), // the eyes of the views that would be filled
    forget: () => (edits.seen.eyes = []),
    /** Eye [x, y, z] in metres at t in 0..1 of a path. */
    eye: (kind, disparity, t) => eyeOnPath(viewer.description, kind, disparity, t),
    /** Where the eye is, and the rows right, down, forward of the camera's rotation. */
    pose: () => ({ eye: viewer.stage.eye, axes: lookingAxes(viewer.stage.eye, viewer.description.focus) }),
    setView: (kind, disparity, t) => drawn(() => viewer.setView(kind, disparity, t)),
    setLayers: (layers) => drawn(() => viewer.setLayers(layers)), // base, aux or both
    setHeat: (on) => drawn(() => viewer.setHeat(on)),
    setCompare: (split) => drawn(() => viewer.setCompare(split)), // the base's share of the width, or null
    settled: () => viewer.stage.settled(),
    /** The view as the URL of a PNG of this size. */
    picture: async (width, height) => (await viewer.stage.picture(width, height)).toDataURL(),
  };
}
