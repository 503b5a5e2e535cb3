// VR: Spark's session in a headset. Both eyes stay where the scene was filled, and see the page's own colours.
import { SparkXr } from "@sparkjsdev/spark";
import * as THREE from "three";
import { fit } from "./panel.js";
import { headHeld, metresPerUnit } from "./views.js";

const MODE = "immersive-vr";
// Why a browser gives no session, by the name of its error.
const REASONS = {
  NotAllowedError: "the browser did not allow it",
  SecurityError: "the browser did not allow it",
  NotSupportedError: "no headset answered",
  InvalidStateError: "another page is in VR",
};

/** Show `button` where the browser says that it has a headset, or as soon as it has one. */
export async function offerVr(viewer, button, say) {
  const { xr } = navigator;
  if (!xr) return;
  let session = null;
  const look = async () => {
    const hasHeadset = await xr.isSessionSupported(MODE).catch(() => false);
    if (hasHeadset) session ??= new Session(viewer, button, say);
    else if (!session?.session) button.hidden = true;
    if (hasHeadset && session.mode === MODE) button.hidden = false;
  };
  xr.addEventListener?.("devicechange", look);
  await look();
}

/** A session of Spark that says in the page's words why it did not start. */
class Session extends SparkXr {
  constructor(viewer, button, say) {
    super({ renderer: viewer.stage.renderer, element: button, mode: "vr", onReady: (isThere) => (button.hidden = !isThere) });
    Object.assign(this, { viewer, say });
    this.xr = { isSessionSupported: (mode) => navigator.xr.isSessionSupported(mode), requestSession: (...wish) => this.request(...wish) };
    this.place = new Place(viewer);
    const { xr } = this.renderer;
    let wasPlaying = false;
    xr.addEventListener("sessionstart", () => {
      wasPlaying = viewer.playing;
      viewer.pause();
      viewer.inVr = true;
      button.setAttribute("aria-pressed", true);
      this.place.follow(xr);
    });
    xr.addEventListener("sessionend", () => {
      this.renderer.setAnimationLoop(null);
      this.renderer.setPixelRatio(1); // three.js has forgotten it where a session ends before its first picture
      viewer.inVr = false;
      button.setAttribute("aria-pressed", false);
      fit(viewer); // the headset's picture had another size
      if (wasPlaying) viewer.play();
      wasPlaying = false;
    });
  }

  request(...wish) {
    return navigator.xr.requestSession(...wish).catch((error) => {
      this.reason = REASONS[error.name] ?? error.message;
      throw error;
    });
  }

  /** Spark's button calls this: begin a session, or end it. */
  async toggleXr() {
    if (!this.viewer.description) return;
    this.reason = null;
    await super.toggleXr();
    if (this.reason) return this.say(`VR did not start: ${this.reason}.`);
    if (!this.session || this.renderer.xr.isPresenting) return;
    await this.session.end();
    this.say("VR did not start: the headset takes no picture of this page.");
  }
}

/** Where the head is in the scene: at the photo's eye to begin with, and never farther from it than was filled. */
class Place {
  constructor(viewer) {
    this.viewer = viewer;
    this.home = null; // the head's place that is the photo's eye: {position, turn}
  }

  /** Draw what the eyes of a session see, from where the head is now. */
  follow(xr) {
    const anew = () => (this.home = null);
    const session = xr.getSession();
    anew();
    // A press or a pinch goes back to the photo's own view, as a double click does on the page.
    session.addEventListener("select", anew);
    session.addEventListener("visibilitychange", () => session.visibilityState === "visible" && anew()); // it was taken off
    xr.getReferenceSpace().addEventListener("reset", anew); // the headset's own button for this
    xr.setAnimationLoop((time, frame) => {
      const pose = frame.getViewerPose(xr.getReferenceSpace());
      if (!pose || !this.viewer.description) return;
      this.put(xr.getCamera(), pose);
      this.viewer.stage.drawEyes();
    });
  }

  /** Bring a headset's cameras from its own space (metres, y up) to the scene (the page's unit, y down). */
  put(head, { transform, views }) {
    const { description } = this.viewer;
    const position = new THREE.Vector3().copy(transform.position);
    this.home ??= { position: position.clone(), turn: heading(transform.orientation) };

    const turned = new THREE.Matrix4().makeRotationX(Math.PI).multiply(new THREE.Matrix4().makeRotationY(-this.home.turn));
    const perMetre = 1 / metresPerUnit(description);
    const moved = position.clone().sub(this.home.position).applyMatrix4(turned).multiplyScalar(perMetre);
    const apart = Math.max(0, ...views.map((view) => position.distanceTo(view.transform.position)));
    const at = new THREE.Vector3(...headHeld(description, moved.toArray(), apart * perMetre));

    // The eyes keep their distance from each other in metres, and everything else follows from the head.
    for (const eye of [head, ...head.cameras]) {
      const place = new THREE.Vector3().setFromMatrixPosition(eye.matrix);
      place.sub(position).applyMatrix4(turned).multiplyScalar(perMetre).add(at);
      eye.matrix.premultiply(turned).setPosition(place);
      eye.matrix.decompose(eye.position, eye.quaternion, eye.scale); // Spark and three.js read both
      flatten(eye.projectionMatrix);
    }
  }
}

/** Angle in radians by which a head is turned to the left about the upright axis. */
function heading({ x, y, z, w }) {
  const forward = new THREE.Vector3(0, 0, -1).applyQuaternion(new THREE.Quaternion(x, y, z, w));
  return Math.atan2(-forward.x, -forward.z);
}

/** Make all depths 0, as in `Stage.lens`: neither a near hand nor a far sky is cut off. */
function flatten({ elements }) {
  for (const third of [2, 6, 10, 14]) elements[third] = 0;
}
