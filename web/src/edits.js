// Changes to the scene that the server makes: holes are filled, things are taken out; each can be undone.
import { Brush } from "./brush.js";
import * as source from "./source.js";
import { lookingAxes } from "./views.js";

const MOST_SEEN = 10; // places that are remembered
const LEAST_APART = 0.04; // disparities between two of them
const LONGEST = 1280; // pixels of a view that is filled
const MASK_LONGEST = 1024; // pixels of the view in which somebody has painted
const element = (id) => document.getElementById(id);

/** The places from which a person has looked at the scene: few, and far apart. */
export class Seen {
  constructor(viewer) {
    this.viewer = viewer;
    this.eyes = [];
    for (const event of ["turn", "change"]) viewer.addEventListener(event, () => this.note(viewer.stage.eye));
  }

  note(eye) {
    const unit = this.viewer.description?.orbit.unit;
    if (!unit || this.eyes.some((other) => distance(other, eye) < LEAST_APART * unit)) return;
    this.eyes.push([...eye]);
    if (this.eyes.length <= MOST_SEEN) return;
    // Of the two that are closest together, the older one says least.
    let closest = [Infinity, 0];
    for (let i = 0; i < this.eyes.length; i++) {
      for (let j = i + 1; j < this.eyes.length; j++) {
        const apart = distance(this.eyes[i], this.eyes[j]);
        if (apart < closest[0]) closest = [apart, i];
      }
    }
    this.eyes.splice(closest[1], 1);
  }

  /** The photo's own place, those that were seen, and the present one, which comes last. */
  withPresent() {
    const now = this.viewer.stage.eye;
    const { unit } = this.viewer.description.orbit;
    const others = this.eyes.filter((eye) => distance(eye, now) > 1e-3 * unit && Math.hypot(...eye) > 1e-3 * unit);
    const home = Math.hypot(...now) > 1e-3 * unit ? [[0, 0, 0]] : [];
    return [...home, ...others, [...now]];
  }
}

/** The scene's camera at an eye, as the server takes it: {K, world_to_camera, width, height}. */
export function cameraAt(description, eye, { scale, x, y } = { scale: 1, x: 0, y: 0 }, longest = LONGEST) {
  const { K, width: W, height: H } = description.camera;
  const factor = Math.min(1, longest / Math.max(W, H));
  const [width, height] = [W, H].map((side) => Math.max(2, 2 * Math.round((side * factor) / 2)));
  // The centre in -1..1, y down, zoomed and shifted as `Stage.lens` does it.
  const cx = scale * ((2 * K[0][2]) / W - 1) + x;
  const cy = scale * ((2 * K[1][2]) / H - 1) - y;
  const rows = lookingAxes(eye, description.focus);
  const unit = description.lengthFactor ?? 1; // of the page's lengths in the scene's
  return {
    K: [
      [(K[0][0] * scale * width) / W, 0, ((cx + 1) / 2) * width],
      [0, (K[1][1] * scale * height) / H, ((cy + 1) / 2) * height],
      [0, 0, 1],
    ],
    world_to_camera: [
      ...rows.map((row) => [...row, -row.reduce((sum, value, axis) => sum + value * eye[axis], 0) / unit]),
      [0, 0, 0, 1],
    ],
    width,
    height,
  };
}

/**
 * The buttons that change the scene. `page` has say(text), progress(stage, share), begin(id), end() and swapped(from, to):
 * the page follows one piece of work at a time, and may stop it.
 */
export class Edits {
  constructor(viewer, page) {
    Object.assign(this, { viewer, page, allowed: false, busy: false, parent: null, redoable: [] });
    this.seen = new Seen(viewer);
    this.brush = new Brush();
    element("fill").onclick = () => this.fill();
    element("remove").onclick = () => this.paint(true);
    element("undo").onclick = () => this.undo();
    element("redo").onclick = () => this.redo();
    element("brush-undo").onclick = () => this.brush.undo();
    element("brush-cancel").onclick = () => this.paint(false);
    element("stop").addEventListener("click", () => (this.stopped = true));
    element("brush-go").onclick = () => this.remove();
    this.brush.addEventListener("change", () => this.update());
    addEventListener("keydown", (event) => this.key(event));
    this.update();
  }

  /** Another scene is on the page; null where no server has it. */
  async shown(id) {
    this.seen.eyes = [];
    this.paint(false);
    this.redoable = history.state?.redo ?? [];
    await this.learn(id);
  }

  /** Ask the server what can be undone. */
  async learn(id) {
    const { parent = null, files = [] } = id ? await source.state(id) : {};
    // The server may have forgotten it.
    this.parent = parent && (await source.state(parent).then(() => parent, () => null));
    document.querySelector("#download [value='removed.ply']").hidden = !files.includes("removed.ply");
    this.update();
  }

  update() {
    const usable = this.allowed && Boolean(this.viewer.id);
    element("edits").hidden = !usable;
    for (const name of ["fill", "remove"]) element(name).disabled = this.busy;
    element("undo").disabled = this.busy || !this.parent;
    element("redo").disabled = this.busy || !this.redoable.length;
    const marked = this.brush.strokes.length > 0;
    element("brush-undo").disabled = element("brush-go").disabled = this.busy || !marked;
  }

  key(event) {
    const { key, target } = event;
    if (element("edits").hidden || element("edits").inert) return;
    if (key === "Escape" && this.brush.open && !this.busy) return this.paint(false);
    const types = target.matches?.("input:not([type=range]), select, textarea");
    if (!(event.ctrlKey || event.metaKey) || event.altKey || types || this.busy) return;
    const letter = key.toLowerCase();
    if (letter !== "z" && letter !== "y") return;
    event.preventDefault();
    const forward = letter === "y" || event.shiftKey;
    if (this.brush.open) return forward || this.brush.undo();
    if (forward) this.redo();
    else this.undo();
  }

  /** Begin or end to mark what is to go. */
  paint(on) {
    if (this.busy || on === this.brush.open) return;
    if (on) {
      this.viewer.pause();
      this.viewer.setCompare(null);
      this.viewer.setLayers("both");
    }
    document.body.classList.toggle("painting", on);
    element("view").inert = on; // the strokes belong to this view
    if (on) this.brush.start();
    else this.brush.stop();
    element(on ? "brush-size" : "view").focus({ preventScroll: true });
  }

  async fill() {
    const { description } = this.viewer;
    const cameras = this.seen.withPresent().map((eye) => cameraAt(description, eye));
    await this.make(() => source.fill(this.viewer.id, cameras), "fill-seen", async (id, { added }) => {
      if (added) return true;
      await source.remove(id);
      this.page.say("There is no hole in what you have looked at. Turn the picture until you see one, then fill.");
      return false;
    });
  }

  async remove() {
    const { stage, description } = this.viewer;
    const camera = cameraAt(description, stage.eye, stage.zoom, MASK_LONGEST);
    const mask = await this.brush.mask(camera.width, camera.height);
    const done = await this.make(() => source.cut(this.viewer.id, camera, mask), "remove", () => true);
    if (done) this.paint(false);
  }

  /** Have the server make another scene of this one, and show it; whether it is shown. */
  async make(send, stage, isWanted) {
    if (this.busy) return false;
    this.viewer.pause();
    this.setBusy(true);
    this.stopped = false;
    this.page.progress(stage, null);
    let done = false;
    try {
      const id = await send();
      this.page.begin(id);
      await source.follow(id, (news) => this.page.progress(news.stage ?? stage, news.share));
      const report = await (await source.fetched(id, "report.json")).text();
      if (await isWanted(id, JSON.parse(report))) {
        this.redoable = [];
        await this.swap(id);
        done = true;
      }
    } catch (error) {
      this.page.say(this.stopped ? "Stopped. Nothing has changed." : error.message);
    }
    this.page.end();
    this.setBusy(false);
    return done;
  }

  undo() {
    if (this.parent) return this.step(this.parent, [...this.redoable, this.viewer.id]);
  }

  redo() {
    if (this.redoable.length) return this.step(this.redoable.at(-1), this.redoable.slice(0, -1));
  }

  /** Show a former or a later state. */
  async step(id, redoable) {
    if (this.busy || this.brush.open) return;
    this.setBusy(true);
    try {
      const before = this.redoable;
      this.redoable = redoable;
      await this.swap(id).catch((error) => {
        this.redoable = before;
        throw error;
      });
    } catch (error) {
      this.page.say(error.message);
    }
    this.setBusy(false);
  }

  /** Put another state of the scene in the place of this one: nobody moves, nothing flickers. */
  async swap(id) {
    const { description, layers } = await source.load(id);
    this.page.swapped(this.viewer.id, id);
    await this.viewer.replace(description, layers, id);
    history.replaceState({ redo: this.redoable }, "", `#${id}`);
    await this.learn(id);
  }

  setBusy(busy) {
    this.busy = busy;
    this.update();
  }
}

function distance(a, b) {
  return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
}
