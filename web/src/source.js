// Where scenes come from: this very file, or the server that handed out the page.
import { gunzip } from "./bytes.js";

/** The scene in this file, or null where a server has it. */
export async function embedded() {
  const element = document.getElementById("spackle-scene");
  if (!element) return null;
  const { description, files } = JSON.parse(element.textContent);
  element.remove(); // the text is as large as the scene
  return withBytes(description, (file) => gunzip(files[file]));
}

/** What the server shows now: {scene, job, upload}. */
export async function current() {
  return (await answer(await fetch(here("/scene.json"), { cache: "no-store" }))).json();
}

/** A scene of the server; `onProgress` hears of shares in 0..1. */
export async function load(url, onProgress = () => {}) {
  const description = await (await answer(await fetch(here(url)))).json();
  const folder = url.replace(/\.json$/, "");
  const sizes = description.layers.map((layer) => 20 * layer.count);
  const all = Math.max(1, sizes.reduce((sum, size) => sum + size, 0));
  let read = 0;
  return withBytes(description, async (file) => {
    const { body } = await answer(await fetch(here(`${folder}/${file}`)));
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

/** Give the server a photo, and a depth map behind it; the URL of the job that completes it. */
export async function send(photo, { base = "", disparity = "", depth = null } = {}) {
  const fields = new URLSearchParams({ name: photo.name });
  if (base) fields.set("base", base);
  if (disparity) fields.set("disparity", disparity);
  if (depth?.size) fields.set("depth", `${/\.[^.]*$/.exec(depth.name.toLowerCase())?.[0]}:${depth.size}`);
  const body = depth?.size ? new Blob([photo, depth]) : photo;
  const response = await fetch(here(`/photos?${fields}`), { method: "POST", body, headers: { "Content-Type": "application/octet-stream" } });
  return (await (await answer(response)).json()).job;
}

/** Watch a job until it ends; the URL of its scene. `onNews` hears of {stage, done, total} and {line}. */
export function follow(job, onNews) {
  return new Promise((resolve, reject) => {
    const events = new EventSource(here(`${job}/events`));
    let lost = 0;
    events.onmessage = ({ data }) => {
      lost = 0;
      const news = JSON.parse(data);
      if ("ready" in news || "error" in news) events.close();
      if ("ready" in news) resolve(news.ready);
      else if ("error" in news) reject(new Error(news.error));
      else onNews(news);
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
  const layers = await Promise.all(description.layers.map(async (layer) => ({ ...layer, bytes: await read(layer.file) })));
  return { description, layers };
}

/** The response, or an error with the server's own line. */
async function answer(response) {
  if (response.ok) return response;
  const line = await response.json().then(({ error }) => error, () => null);
  throw new Error(line ?? `the server answered ${response.status}`);
}
