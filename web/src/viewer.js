// What is shown: a scene, an eye, a path, layers. Everything else asks this for changes and listens to it.
import { Stage } from "./stage.js";
import { disparityOf, eyeOnPath, held, pulledTo } from "./views.js";

export const KINDS = ["swipe", "shake", "rotate", "rotate-forward"];
const TURN_S = 8; // seconds that a path takes, there and back where it is open
const GLIDE_S = 0.7; // seconds from where the eye is to the path
const FIRST_GLIDE_S = 2.5; // seconds from the photo's own eye to the path
const MOST_PIXELS = 2.6e6;

const USUAL = 0.3; // disparity

export class Viewer extends EventTarget {
  constructor(canvas) {
    super();
    this.canvas = canvas;
    this.stage = new Stage(canvas, () => this.inVr || this.refresh()); // in VR the headset asks for pictures
    this.kind = "rotate-forward";
    this.t = 0; // on the path, 0..1
    this.disparity = USUAL;
    this.onPath = true; // false where a hand holds the eye
    this.playing = false;
    this.inVr = false; // a headset shows the scene
    this.clock = null; // how much of a turn is gone, 0..1
    this.glide = { from: [0, 0, 0], left: 0 };
    this.glideSeconds = GLIDE_S;
    this.frame = 0;
    this.fps = 0;
  }

  get description() {
    return this.stage.description;
  }

  show(description, layers, id = null) {
    this.id = id; // of the server's scene
    this.stage.show(description, layers);
    Object.assign(this.stage.zoom, { scale: 1, x: 0, y: 0 });
    this.home();
    this.clock = null; // the path begins anew, and far from here
    this.glideSeconds = FIRST_GLIDE_S;
  }

  /** Another state of the same scene; everything else stays as it is. */
  async replace(description, layers, id) {
    this.id = id;
    const settled = this.stage.replace(description, layers);
    this.changed();
    await settled;
  }

  changed() {
    this.refresh();
    this.dispatchEvent(new Event("change"));
  }

  refresh() {
    if (!this.frame && this.description) this.frame = requestAnimationFrame((now) => this.tick(now));
  }

  /** Nothing is left to draw: somebody else does it at once. */
  drawnElsewhere() {
    if (this.playing) return;
    cancelAnimationFrame(this.frame);
    this.frame = 0;
  }

  tick(now) {
    this.frame = 0;
    if (this.playing) {
      const step = this.last === undefined ? 0 : Math.min((now - this.last) / 1000, 0.25);
      this.advance(step);
      if (step) this.fps += ((1 / step) - this.fps) * (this.fps ? 0.1 : 1);
      this.last = now;
      this.refresh();
    } else {
      this.last = undefined;
    }
    this.stage.draw();
    this.dispatchEvent(new Event("drawn"));
  }

  /** Go on along the path; an open path goes there and back. */
  advance(seconds) {
    this.clock = (this.clock + seconds / TURN_S) % 1;
    this.t = this.kind === "swipe" ? (1 - Math.cos(2 * Math.PI * this.clock)) / 2 : this.clock;
    this.glide.left = Math.max(0, this.glide.left - seconds / this.glideSeconds);
    if (!this.glide.left) this.glideSeconds = GLIDE_S;
    this.place();
    this.dispatchEvent(new Event("turn"));
  }

  place() {
    const eye = eyeOnPath(this.description, this.kind, this.disparity, this.t);
    const share = this.glide.left ** 2 * (3 - 2 * this.glide.left);
    this.stage.eye = eye.map((value, axis) => value + share * (this.glide.from[axis] - value));
  }

  play(kind = this.kind) {
    const same = kind === this.kind && this.onPath;
    if (!same || this.clock === null) this.clock = kind === "swipe" ? 0.25 : 0;
    if (!same) this.glide = { from: this.stage.eye, left: 1 };
    Object.assign(this, { kind, onPath: true, playing: true, last: undefined });
    this.changed();
  }

  pause() {
    this.playing = false;
    this.changed();
  }

  /** A place on a path, and stay there. */
  setView(kind, disparity, t) {
    const clock = kind === "swipe" ? Math.acos(1 - 2 * t) / (2 * Math.PI) : t % 1;
    Object.assign(this, { kind, disparity, t, clock, onPath: true, playing: false });
    this.glide.left = 0;
    this.place();
    this.changed();
  }

  /** How far to the side: along the path, or along the line that a hand has pulled the eye. */
  setDisparity(disparity) {
    this.disparity = disparity;
    if (!this.onPath) {
      const { eye } = this.stage;
      const far = disparityOf(this.description, eye);
      const [x, y] = far > 1e-6 ? [eye[0] / far, eye[1] / far] : [this.description.orbit.unit, 0];
      this.stage.eye = [x * disparity, y * disparity, eye[2]];
    } else {
      // At a place where every disparity looks the same, go to the widest one.
      const { moving } = this.description.paths[this.kind];
      const at = moving[Math.round(this.t * (moving.length - 1))];
      if (!this.playing) this.glide.left = 0;
      if (!this.playing && Math.hypot(...at) < 1e-3 * this.description.orbit.unit) {
        this.t = this.kind === "swipe" ? 1 : 0.25;
        this.clock = this.kind === "swipe" ? 0.5 : 0.25;
      }
      this.place();
    }
    this.changed();
  }

  /** A hand moves the eye by so many disparities. */
  pull(dx, dy) {
    const from = this.pulled && !this.onPath ? this.pulled : pulledTo(this.description, this.place2d());
    this.pulled = [from[0] + dx, from[1] + dy];
    this.lookFrom(this.pulled);
  }

  /** Where the eye is, to the right and down, in disparities. */
  place2d() {
    const { unit } = this.description.orbit;
    return [this.stage.eye[0] / unit, this.stage.eye[1] / unit];
  }

  /** Put the eye so many disparities to the right and down, as far as it may go. */
  lookFrom(place) {
    const { unit } = this.description.orbit;
    const at = held(this.description, place);
    this.stage.eye = [at[0] * unit, at[1] * unit, this.stage.eye[2]];
    Object.assign(this, { onPath: false, playing: false, disparity: Math.hypot(...at) });
    this.changed();
  }

  /** The hand lets go: the next pull starts from where the eye is. */
  release() {
    this.pulled = null;
  }

  /** Zoom about a point of the canvas, in -1..1 with y up. */
  zoomAt(factor, x, y) {
    const { zoom } = this.stage;
    const scale = Math.min(Math.max(zoom.scale * factor, 1), 8);
    const ratio = scale / zoom.scale;
    Object.assign(zoom, { scale, x: x + (zoom.x - x) * ratio, y: y + (zoom.y - y) * ratio });
    this.shift(0, 0);
  }

  /** Move the zoomed picture, in canvas halves with y up. */
  shift(x, y) {
    const { zoom } = this.stage;
    zoom.x += x;
    zoom.y += y;
    this.stage.clampZoom();
    this.changed();
  }

  /** The photo's own view, and the usual range of a path. */
  home() {
    this.stage.eye = [0, 0, 0];
    this.disparity = Math.min(USUAL, this.description.orbit.free);
    Object.assign(this.stage.zoom, { scale: 1, x: 0, y: 0 });
    Object.assign(this, { onPath: false, playing: false, pulled: null });
    this.changed();
  }

  setLayers(layers) {
    this.stage.layers = layers;
    this.changed();
  }

  setHeat(heat) {
    this.stage.heat = heat;
    this.changed();
  }

  setCompare(split) {
    this.stage.split = split;
    this.changed();
  }

  resize(width, height) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2, Math.sqrt(MOST_PIXELS / (width * height)));
    const [w, h] = [width, height].map((side) => Math.max(1, Math.round(side * ratio)));
    if (this.canvas.width !== w || this.canvas.height !== h) {
      this.stage.resize(w, h);
    }
    // At once, for a canvas that was resized is empty.
    if (this.description) this.stage.draw();
  }
}
