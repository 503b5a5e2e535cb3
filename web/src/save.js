// Pictures, videos and scenes to the disk.
import { fetched } from "./source.js";

/** The view as a PNG, not smaller than the photo. */
export async function savePicture(viewer) {
  const { width, height } = sharpest(viewer);
  const canvas = await viewer.stage.picture(width, height);
  const blob = await new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  download(blob, `${fileName(viewer)}.png`);
}

/** A file that the server makes of the scene, for as long as that takes; `onNews` as in `fetched`. */
export async function saveFile(viewer, name, onNews) {
  const kind = name === "removed.ply" ? "-without-patch" : "";
  download(await fetched(viewer.id, name, "", onNews), fileName(viewer) + kind + /\.[^.]*$/.exec(name)[0]);
}

function sharpest({ canvas, description }) {
  const { width, height } = description.camera;
  const larger = Math.max(1, width / canvas.width, height / canvas.height);
  return { width: Math.round(canvas.width * larger), height: Math.round(canvas.height * larger) };
}

/** One turn of the path as a video; resolves when it is saved. Null where the browser cannot. */
export function recorder(viewer) {
  const kinds = ["video/webm;codecs=vp9", "video/webm;codecs=vp8", "video/webm", "video/mp4"];
  const kind = window.MediaRecorder && viewer.canvas.captureStream && kinds.find((type) => MediaRecorder.isTypeSupported(type));
  if (!kind) return null;
  return async (onProgress) => {
    const parts = [];
    const media = new MediaRecorder(viewer.canvas.captureStream(30), { mimeType: kind, videoBitsPerSecond: 12e6 });
    media.ondataavailable = ({ data }) => parts.push(data);
    const stopped = new Promise((resolve) => (media.onstop = resolve));
    viewer.setView(viewer.kind, viewer.disparity, 0);
    viewer.play();
    media.start();
    await oneTurn(viewer, onProgress);
    media.stop();
    await stopped;
    for (const track of media.stream.getTracks()) track.stop();
    viewer.pause();
    download(new Blob(parts, { type: kind }), `${fileName(viewer)}.${kind.includes("mp4") ? "mp4" : "webm"}`);
  };
}

/** Until the path has been gone once, or somebody stops it. */
function oneTurn(viewer, onProgress) {
  return new Promise((resolve) => {
    let before = 0;
    const over = () => {
      viewer.removeEventListener("turn", turned);
      viewer.removeEventListener("change", stopped);
      resolve();
    };
    const turned = () => {
      onProgress(viewer.clock);
      if (viewer.clock < before) over();
      before = viewer.clock;
    };
    const stopped = () => viewer.playing || over();
    viewer.addEventListener("turn", turned);
    viewer.addEventListener("change", stopped);
  });
}

export function fileName({ description }) {
  return description.name.replace(/\.[^.]*$/, "").replace(/[^\p{L}\p{N}._-]+/gu, "-") || "scene";
}

export function download(blob, name) {
  const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
