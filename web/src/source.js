// Where scenes come from: this very file, or the server that handed out the page.
import { gunzip } from "./bytes.js";
import { expand } from "./compact.js";

/** The scene in this file, or null where a server has it. */
export async function embedded() {
  const element = document.getElementById("spackle-scene");
  if (!element) return null;
  const { description, files, compact } = JSON.parse(element.textContent);
  element.remove(); // the text is as large as the scene
  return withBytes(description, async (file) => {
    const bytes = await gunzip(files[file]);
    if (!compact.includes(file)) return bytes;
    const { count } = description.layers.find((layer) => layer.file === file);
    return expand(bytes, count, description.camera);
  });
}

const SCENES = "/api/v1/scenes";
const ASK_MS = 400; // between two questions how far a file is

/** What the server takes: {upload}. */
export async function current() {
  return (await answer(await fetch(here("/page.json"), { cache: "no-store" }))).json();
}

/** How far the download of a better network is: {bytes, licence, state, share, error}. */
export async function better() {
  return (await answer(await fetch(here("/better-depth"), { cache: "no-store" }))).json();
}

/** Have the server begin this download. */
export async function fetchBetter() {
  return (await answer(await fetch(here("/better-depth"), { method: "POST" }))).json();
}

/** How far a scene is, and the `files` that are there. */
export async function state(id) {
  return (await answer(await fetch(here(`${SCENES}/${id}`)))).json();
}

/** The address of a scene's file. */
export function file(id, name) {
  return here(`${SCENES}/${id}/files/${name}`);
}

/** A scene of the server; `onProgress` hears of shares in 0..1. */
export async function load(id, onProgress = () => {}) {
  const description = await (await answer(await fetch(file(id, "page.json")))).json();
  const sizes = description.layers.map(({ count, harmonics }) => count * (20 + (harmonics ? 3 + 3 * harmonics.count : 0)));
  const all = Math.max(1, sizes.reduce((sum, size) => sum + size, 0));
  let read = 0;
  return withBytes(description, async (name) => {
    const { body } = await answer(await fetch(file(id, name)));
    const parts = [];
    for (const reader = body.getReader(); ;) {
      const { done, value } = await reader.read();
      if (done) break;
      parts.push(value);
      onProgress((read += value.length) / all);
    }
    return new Uint8Array(await new Blob(parts).arrayBuffer());
  });
}

/**
 * A file that the server makes of a scene; it may take a while. A page may have a caption. `onNews` hears meanwhile how far
 * it is: {place, share}, the files that come before, or null; and what is made of it in 0..1, or null while nobody knows.
 */
export async function fetched(id, name, caption = "", onNews = () => {}) {
  const query = caption && `?caption=${encodeURIComponent(caption)}`;
  let isOver = false;
  const timer = setInterval(async () => {
    // A state that does not come is asked for again; whether the file comes, its own answer says.
    const { making } = await state(id).catch(() => ({ making: [] }));
    const news = making.find((each) => each.file === name);
    if (news && !isOver) onNews(news);
  }, ASK_MS);
  try {
    return await (await answer(await fetch(file(id, name) + query))).blob();
  } finally {
    isOver = true;
    clearInterval(timer);
  }
}

/** How far a file is that the server makes, in words that follow what it is. */
export function howFar({ place, share }) {
  if (place !== null) return ", which waits for its turn";
  return share === null ? "" : `: ${Math.round(100 * share)} %`;
}

/** The address of a page that shows one scene, or null where everybody can see the server's own. */
export async function link(id, caption) {
  const asked = here(`${SCENES}/${id}/link?caption=${encodeURIComponent(caption)}`);
  const { path } = await (await answer(await fetch(asked))).json();
  return path && new URL(path, location.href).href;
}

/** Give the server a photo; the id of its scene. */
export async function send(photo, { base = "", disparity = "", depth = null, depth_kind = "", depth_unit = "" } = {}) {
  const form = new FormData();
  form.set("photo", photo, photo.name);
  if (depth?.size) form.set("depth", depth, depth.name);
  const options = { files: [], ...(base && { base }), ...(disparity && { disparity: Number(disparity) }) };
  if (depth?.size && depth_kind) options.depth_kind = depth_kind;
  if (depth?.size && depth_unit) options.depth_unit = depth_unit;
  form.set("options", JSON.stringify(options));
  return (await (await answer(await fetch(here(SCENES), { method: "POST", body: form }))).json()).id;
}

/** Have the server fill a scene where cameras see holes; the id of the scene that it makes. */
export function fill(id, cameras) {
  return edit(`${id}/fill`, { cameras });
}

/** Have the server take out what a mask marks in a camera's view, and fill what it hid; the id of the scene that it makes. */
export function cut(id, camera, mask) {
  return edit(`${id}/remove`, { camera }, mask);
}

async function edit(path, options, mask = null) {
  const form = new FormData();
  form.set("options", JSON.stringify(options));
  if (mask) form.set("mask", mask, "mask.png");
  return (await (await answer(await fetch(here(`${SCENES}/${path}`), { method: "POST", body: form }))).json()).id;
}

/** Have the server forget a scene, and end the work on it. */
export async function remove(id) {
  await answer(await fetch(here(`${SCENES}/${id}`), { method: "DELETE" }));
}

/** Watch a photo until its scene is done. `onNews` hears of its state: {stage, share, line}. */
export function follow(id, onNews) {
  return new Promise((resolve, reject) => {
    const events = new EventSource(here(`${SCENES}/${id}/events`));
    let lost = 0;
    events.onmessage = ({ data }) => {
      lost = 0;
      const news = JSON.parse(data);
      if (news.ended === null) return onNews(news);
      events.close();
      if (news.state === "done") resolve();
      else reject(new Error(news.error));
    };
    events.onerror = () => {
      if (events.readyState !== EventSource.CLOSED && ++lost < 5) return; // it connects again by itself
      events.close();
      reject(new Error("the connection to Spackle was lost: is it still running?"));
    };
  });
}

/** A path of the server below the page's own address, which may hold a token. */
export function here(path) {
  return new URL(`.${path}`, document.baseURI).href;
}

async function withBytes(description, read) {
  const layers = description.layers.map(async (layer) => {
    const whole = { ...layer, bytes: await read(layer.file) };
    if (layer.harmonics) whole.harmonics = { ...layer.harmonics, bytes: await read(layer.harmonics.file) };
    return whole;
  });
  return { description, layers: await Promise.all(layers) };
}

/** The response, or an error with the server's own line. */
async function answer(response) {
  if (response.ok) return response;
  const line = await response.json().then(({ error }) => error, () => null);
  throw new Error(line ?? `the server answered ${response.status}`);
}
