// Starts the page: finds a scene, shows it, and takes further photos where there is a server.
import { offerBetter } from "./better.js";
import { control } from "./controls.js";
import { cameraAt, Edits } from "./edits.js";
import { gift, isGift } from "./gift.js";
import { divider, fit, name, panel, roomy, unfold } from "./panel.js";
import { Queue } from "./queue.js";
import { sharing } from "./share.js";
import * as source from "./source.js";
import { KINDS, Viewer } from "./viewer.js";
import { eyeOnPath, lookingAxes } from "./views.js";
import { offerVr } from "./vr.js";

// What is said of a stage of the work; of all others nothing but that there is work.
const STAGES = {
  "warm-up": "First photo: preparing, about half a minute",
  load: "Loading", prepare: "Reading the depth map", base: "Finding depth", move: "Finding how far you can move",
  complete: "Filling what the photo hides",
  "fill-seen": "Filling the holes that you have seen", remove: "Taking it out", patch: "Filling what it hid",
  write: "Almost there", measure: "Almost there", page: "Almost there",
};
const BASES = { auto: "the best that is here", sharp: "SHARP", moge: "MoGe-2", depth: "Depth Anything", lite: "lite: quick, and rough" };
const element = (id) => document.getElementById(id);
const viewer = started();
let upload = null; // what the server takes, where there is one
let watched = null; // the photo whose progress the page shows
let editing = null; // the id of the scene that an edit makes
let opening = 0; // counts the scenes that were asked for: only the last one is shown
let edits = null;
let queue = null;

if (viewer) {
  control(viewer.canvas, viewer);
  panel(viewer, say);
  divider(viewer);
  sharing(viewer, say);
  offerVr(viewer, element("vr"), say);
  queue = new Queue(element("queue"), { work, ended, pick, stop, shows, resized: () => fit(viewer) });
  edits = new Edits(viewer, { say, progress, begin: (id) => (editing = id), end, swapped });
  uploads();
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
  if (own) {
    gift(viewer);
    const { title } = document; // the file's own, which stays: a photo's name without .jpg
    return show(own).then(() => {
      document.title = title;
      viewer.canvas.setAttribute("aria-label", title);
    });
  }
  ({ upload } = await source.current());
  element("open").hidden = !upload;
  edits.allowed = Boolean(upload);
  if (upload) element("file").accept = ["image/*", ...upload.suffixes].join(",");
  offerBases();
  offerBetter(element("better"), upload?.better_depth, { say, done: useBetter });
  addEventListener("hashchange", () => chosen() && chosen() !== viewer.id && visit(chosen()));
  for (const button of document.querySelectorAll("[data-example]")) button.firstChild.src = source.here(`/${button.dataset.example}`);
  return chosen() ? visit(chosen()) : start();
}

function offerBases() {
  const bases = (upload?.bases ?? []).map((name) => new Option(BASES[name] ?? name, name));
  element("choices").querySelector("[name=base]").replaceChildren(...bases);
}

/** A better network is here: use it, at once for the photo that is shown. */
async function useBetter() {
  ({ upload } = await source.current());
  offerBases();
  const item = queue.withId(viewer.id);
  if (!item?.file) return say("Better depth is here, for the photos that you add next.");
  say("Better depth is here: your photo is done again.");
  take([item.file]);
}

/** The page without a scene. */
function start() {
  const way = matchMedia("(hover: hover)").matches ? "Drop a photo here, or choose one" : "Choose a photo";
  notice("Step into your photo", upload ? `${way}, and look behind what stands in front.` : "The address names no scene.");
  element("notice").classList.add("empty");
}

/** The scene that the address names. */
function chosen() {
  return /^#([0-9a-f]{16})$/.exec(location.hash)?.[1];
}

async function show({ description, layers }, id = null) {
  viewer.show(description, layers, id);
  name(description);
  element("name").textContent = description.name;
  document.title = `${description.name} · Spackle`;
  element("frame").hidden = false;
  element("frame").classList.add("waiting");
  element("open").after(element("choices"));
  document.body.classList.remove("idle");
  fit(viewer);
  if (roomy()) unfold(true);
  await viewer.stage.settled();
  element("frame").classList.remove("waiting");
  element("notice").hidden = true;
  element("download").hidden = !id;
  await edits.shown(id);
  if (description.note && !isGift()) say(description.note);
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) viewer.play();
}

/** Show a scene of the server, which may still be in work. */
async function visit(id) {
  const known = queue.withId(id);
  if (known) return pick(known);
  try {
    const { name, files } = await source.state(id);
    const item = { id, name, url: files.includes("photo.jpg") ? source.file(id, "photo.jpg") : null, watch: true };
    await queue.adopt(item);
  } catch (error) {
    failed(error);
  }
}

/** Have the server make the scene of a photo. */
async function work(item) {
  if (item.watch || !viewer.description) watch(item);
  const stopped = new Promise((_, reject) => (item.end = () => reject(new Error("Stopped"))));
  stopped.catch(() => {});
  await Promise.race([made(item), stopped]);
}

async function made(item) {
  const { file } = item;
  if (!item.id) {
    // What the file is, the server sees in its content; only what is surely no photo stays here.
    if (/^(video|audio|text)\//.test(file.type)) throw new Error(`${file.name}: not a photo`);
    if (file.size > upload.max_bytes) throw new Error(`${file.name} is larger than ${Math.floor(upload.max_bytes / 1e6)} MB`);
    item.id = await source.send(file, item.options);
    if (item.stopped) return source.remove(item.id);
    if (watched === item) named(item.id);
  }
  await source.follow(item.id, (news) => {
    item.news = news;
    if (watched === item) progress(news.stage, news.share);
  });
}

/** The work on a photo is over: show its scene, if somebody waits for it, or say why there is none. */
async function ended(item) {
  const isWatched = watched === item;
  if (item.state === "done") return isWatched && showScene(item);
  if (isWatched) leave();
  if (!isWatched) return say(item.stopped ? "Stopped" : item.line);
  if (!item.stopped) return failed(new Error(item.line));
  if (viewer.description) restore();
  else start();
  say("Stopped");
}

/** A person has clicked a photo of the queue. */
function pick(item) {
  if (edits.busy) return say("One moment: the scene is being changed.");
  if (item.state === "done") return showScene(item);
  if (item.state === "working") return watch(item);
  say(item.line || `${item.name}: waiting for its turn`);
}

function stop(item) {
  item.stopped = true;
  item.end?.();
  if (item.id) source.remove(item.id).catch((error) => say(error.message));
}

/** Whether the page shows this photo, or its scene. */
function shows(item) {
  return watched ? watched === item : Boolean(item.id) && item.id === viewer?.id;
}

/** Show the progress of a photo; the photo stands in the scene's place meanwhile. */
function watch(item) {
  watched = item;
  viewer.playing = false; // the processor is needed elsewhere
  element("edits").inert = true; // they are of a scene that is not seen now
  if (item.id) named(item.id);
  stand(item);
  progress(item.news?.stage ?? null, item.news?.share ?? null);
  queue.draw();
}

/** Nobody waits for a photo any longer. */
function leave() {
  watched = null;
  element("edits").inert = false;
  stand(null);
  queue.draw();
}

async function showScene(item) {
  const mine = ++opening;
  if (!watched) watch(item);
  try {
    const scene = await source.load(item.id, (share) => mine === opening && progress("load", share));
    if (mine !== opening) return;
    named(item.id);
    await show(scene, item.id);
    if (mine === opening) leave();
  } catch (error) {
    if (mine !== opening) return;
    leave();
    failed(error);
  }
}

/** The address names a scene; what can be done again stays, if it is that of the same scene. */
function named(id) {
  if (chosen() !== id) history.replaceState(null, "", `#${id}`);
}

/** The work on a scene that is shown is over. */
function end() {
  editing = null;
  element("notice").hidden = true;
}

/** An edit has put another scene in the place of one. */
function swapped(from, to) {
  const item = queue.withId(from);
  if (item) item.id = to;
}

/** Show the picture of a photo until its scene is there; null: no longer. */
function stand(item) {
  const photo = element("photo");
  const url = item?.url;
  if (!url) return;
  photo.onload = () => {
    if (watched !== item) return;
    element("frame").hidden = false;
    element("frame").classList.add("waiting");
    fit(viewer, { width: photo.naturalWidth, height: photo.naturalHeight });
  };
  // Not every browser shows every kind of photo; the server makes a JPEG of each.
  photo.onerror = async () => {
    if (!url.startsWith("blob:")) return;
    while (watched === item && !item.id) await new Promise((resolve) => setTimeout(resolve, 200));
    if (watched !== item) return;
    item.url = source.file(item.id, "photo.jpg");
    stand(item);
  };
  Object.assign(photo, { src: url, alt: `${item.name}, until its scene is ready`, ariaHidden: null });
}

/** Queue photos; what the options say holds for them. */
function take(files) {
  if (!upload) return say("This page shows its scene, and takes no photos.");
  const options = choices();
  element("choices").open = false;
  const isIdle = !watched && !edits.busy && !queue.sending;
  queue.add([...files].map((file, index) => ({
    name: file.name, file, url: URL.createObjectURL(file), watch: isIdle && index === 0,
    options: index ? { ...options, depth: null } : options, // a depth map is of one photo
  })));
  if (options.depth?.size && files.length > 1) say(`The depth map goes with ${files[0].name}.`);
}

function uploads() {
  const file = element("file");
  for (const button of document.querySelectorAll("[data-do=open]")) button.onclick = () => file.click();
  for (const button of document.querySelectorAll("[data-example]")) button.onclick = () => example(button.dataset.example);
  element("stop").onclick = () => {
    if (editing) source.remove(editing).catch((error) => say(error.message));
    else if (watched) stop(watched);
  };
  file.onchange = () => {
    if (file.files.length) take([...file.files]);
    file.value = "";
  };
  const { elements } = element("choices").querySelector("form");
  viewer.canvas.addEventListener("pointerdown", () => document.body.classList.contains("idle") || (element("choices").open = false));
  elements.depth.onchange = elements.depth_kind.onchange = offerReadings;
  addEventListener("dragover", (event) => {
    event.preventDefault();
    if (upload && event.dataTransfer?.types.includes("Files")) document.body.classList.add("dropping");
  });
  addEventListener("dragleave", (event) => event.relatedTarget || document.body.classList.remove("dropping"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("dropping");
    dropped(event.dataTransfer);
  });
  addEventListener("paste", (event) => {
    if (event.target.matches?.("input:not([type=range]), textarea")) return;
    const files = [...event.clipboardData.files];
    if (files.length) take(files.map((each) => (each.name === "image.png" ? new File([each], "Pasted picture.png", { type: each.type }) : each)));
    else if (upload) say("The clipboard holds no picture.");
  });
}

function dropped(transfer) {
  const files = [...transfer.files];
  const folder = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).find((entry) => entry?.isDirectory);
  if (folder) return say(`${folder.name} is a folder: drop the photos in it.`);
  if (!files.length) return say("Only files can be dropped here: save the picture first, or copy it and press Ctrl+V.");
  take(files);
}

/** One of the photos that come with the page. */
async function example(name) {
  const photo = await (await fetch(source.here(`/${name}`))).blob();
  take([new File([photo], name, { type: photo.type })]);
}

/** Show how a depth map may be read: its kind, and for distances the unit. */
function offerReadings() {
  const { depth, depth_kind: kind } = element("choices").querySelector("form").elements;
  element("kind").hidden = !depth.files[0];
  element("unit").hidden = !depth.files[0] || !["", "metric"].includes(kind.value);
}

/** What the options say: {base, disparity, depth, depth_kind, depth_unit}. */
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
  if (!busy && !viewer?.description) element("frame").hidden = true;
  box.hidden = false;
  box.classList.remove("empty");
  box.classList.toggle("busy", busy);
  box.classList.toggle("may-open", !busy && Boolean(upload));
  box.classList.toggle("may-stop", busy && Boolean(upload) && Boolean(editing || watched));
  if (!busy) box.append(element("choices"));
  box.querySelector("h2").textContent = title;
  box.querySelector("p").textContent = text;
}

/** `share` in 0..1, or null where nobody knows. */
function progress(stage, share) {
  notice(STAGES[stage] ?? "Working on your photo", "", true);
  const bar = element("notice").querySelector("progress");
  if (share === null) bar.removeAttribute("value");
  else bar.value = share;
}

function failed(error) {
  if (viewer.description) {
    restore();
    say(error.message);
  } else {
    notice("That did not work", error.message);
  }
}

/** Show the former scene again. */
function restore() {
  element("frame").classList.remove("waiting");
  element("notice").hidden = true;
  history.replaceState(history.state, "", `#${viewer.id ?? ""}`);
  fit(viewer);
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
    /** Where the eye is, the rows right, down, forward of the camera's rotation, and the zoom {scale, x, y}. */
    pose: () => ({
      eye: viewer.stage.eye, axes: lookingAxes(viewer.stage.eye, viewer.description.focus), zoom: { ...viewer.stage.zoom },
    }),
    setView: (kind, disparity, t) => drawn(() => viewer.setView(kind, disparity, t)),
    setLayers: (layers) => drawn(() => viewer.setLayers(layers)), // base, aux or both
    setHeat: (on) => drawn(() => viewer.setHeat(on)),
    setCompare: (split) => drawn(() => viewer.setCompare(split)), // the base's share of the width, or null
    settled: () => viewer.stage.settled(),
    /** The view as the URL of a PNG of this size. */
    picture: async (width, height) => (await viewer.stage.picture(width, height)).toDataURL(),
  };
}
