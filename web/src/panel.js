// The bar below the picture, what stands beside it, and the size of the picture.
import { isGift } from "./gift.js";
import { recorder, saveFile, savePicture } from "./save.js";
import { howFar } from "./source.js";

const ROOM = 230; // pixels beside the picture in which the controls may stay unfolded
// What is called how, in a scene of a photo and in one that another program made.
const WORDS = {
  photo: { base: "What the photo shows", left: "The photo alone", heat: "What the photo does not show", legend: "not in the photo" },
  scene: { base: "The scene as it was", left: "As it was", heat: "Where the scene was empty", legend: "empty before" },
};
const element = (id) => document.getElementById(id);

export function panel(viewer, say) {
  const slider = element("disparity");
  const paths = [...element("paths").children];
  const layers = [...element("layers").children];
  const record = recorder(viewer);

  element("play").onclick = () => (viewer.playing ? viewer.pause() : viewer.play());
  slider.oninput = () => viewer.setDisparity(slider.valueAsNumber);
  for (const button of paths) {
    const { kind } = button.dataset;
    button.onclick = () => (viewer.playing && viewer.onPath && viewer.kind === kind ? viewer.pause() : viewer.play(kind));
  }
  for (const button of layers) {
    button.onclick = () => {
      viewer.setCompare(null);
      viewer.setLayers(button.dataset.layers);
    };
  }
  element("heat").onclick = () => viewer.setHeat(!viewer.stage.heat);
  element("compare").onclick = () => viewer.setCompare(viewer.stage.split === null ? 0.5 : null);
  element("reset").onclick = () => viewer.home();
  element("full").hidden = !document.fullscreenEnabled;
  element("full").onclick = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  document.addEventListener("fullscreenchange", () => press("full", Boolean(document.fullscreenElement)));
  element("download").onchange = ({ target }) => {
    const { value } = target;
    made(value.startsWith(".") ? `scene${value}` : value, `Making the ${value} file`);
    target.value = "";
  };
  element("shot").onclick = () => savePicture(viewer).catch((error) => say(`The picture was not saved: ${error.message}`));
  element("record").onclick = async () => {
    if (viewer.id) return made(`${viewer.kind}.mp4`, "Making the video");
    if (!record) return say("This browser cannot record a video.");
    if (pressed("record")) return viewer.pause();
    press("record", true);
    await record((share) => say(`Recording: ${Math.round(100 * share)} %`)).catch((error) => say(`No video: ${error.message}`));
    press("record", false);
    say("");
  };
  element("more").onclick = () => unfold(!element("bar").classList.contains("open"));

  /** Save what the server makes of the scene. */
  async function made(name, line) {
    say(`${line}…`, true);
    await saveFile(viewer, name, (news) => say(line + howFar(news), true)).then(() => say(""), (error) => say(`Not saved: ${error.message}`));
  }

  viewer.addEventListener("change", update);
  viewer.addEventListener("turn", () => !viewer.onPath || showDisparity());
  new ResizeObserver(() => element("frame").classList.contains("waiting") || fit(viewer)).observe(element("area"));

  function update() {
    const { stage, description } = viewer;
    const play = element("play");
    play.classList.toggle("on", viewer.playing);
    play.setAttribute("aria-label", viewer.playing ? "Pause" : "Play");
    for (const button of paths) button.setAttribute("aria-pressed", viewer.onPath && button.dataset.kind === viewer.kind);
    const added = description.layers.some(({ name, count }) => name === "aux" && count);
    for (const button of layers) {
      button.setAttribute("aria-pressed", stage.split === null && button.dataset.layers === stage.layers);
      button.disabled = !added;
    }
    element("compare").disabled = !added;
    press("heat", stage.heat);
    press("compare", stage.split !== null);
    element("frame").classList.toggle("heat", stage.heat);
    showDisparity();
  }

  function showDisparity() {
    slider.max = viewer.description.orbit.limit;
    if (document.activeElement !== slider || !viewer.onPath) slider.value = viewer.disparity;
    slider.style.setProperty("--at", `${(100 * viewer.disparity) / slider.max}%`);
    const shown = distance(viewer);
    slider.setAttribute("aria-valuetext", shown);
    const hint = "How far you move to the side";
    slider.parentElement.title = isGift() ? hint : `${hint}: a disparity of ${viewer.disparity.toFixed(2)} (0.3 is large)`;
    document.querySelector("output[for=disparity]").value = shown;
  }
}

/** How far the eye moves to the side, in words: a length where the scene has one, else how far the nearest thing shifts. */
function distance({ description, disparity }) {
  if (!description.isMetric) return `${Math.round(100 * disparity)} %`;
  const metres = (disparity * description.orbit.unit) / (description.lengthFactor ?? 1);
  if (metres >= 1) return `${metres.toFixed(1)} m`;
  return `${(100 * metres).toFixed(metres < 0.1 ? 1 : 0)} cm`;
}

/** Name the layers, the divider and the holes as it suits a scene. */
export function name(description) {
  const words = WORDS[description.isPhoto ? "photo" : "scene"];
  document.querySelector("[data-layers=base]").textContent = words.base;
  document.querySelector(".tag.left").textContent = words.left;
  element("legend").lastChild.textContent = words.legend;
  element("heat").title = words.heat;
  element("divider").setAttribute("aria-label", `${words.left} to the left of this line, the completed scene to the right`);
  // What a person should know of the scene's quality; the whole note as a hint.
  Object.assign(element("facts"), { textContent: description.note?.split(";")[0] ?? "", title: description.note ?? "" });
  element("view").setAttribute("aria-label", `The scene ${description.name}`);
  // The canvas shows now what the picture showed.
  Object.assign(element("photo"), { alt: "", ariaHidden: "true" });
}

/** Show all controls where a small screen hides them, or hide them again. */
export function unfold(open) {
  element("bar").classList.toggle("open", open);
  element("more").setAttribute("aria-expanded", open);
}

/** Whether the picture leaves the controls all the room that they need. */
export function roomy() {
  return element("area").clientHeight - element("frame").clientHeight > ROOM;
}

/** The picture, or the `photo` in its place, as large as there is room for all of it. */
export function fit(viewer, photo = null) {
  const { width: W, height: H } = photo ?? viewer.description?.camera ?? {};
  if (!W) return;
  const { clientWidth: width, clientHeight: height } = element("area");
  const scale = Math.min(width / W, height / H);
  const [w, h] = [W, H].map((side) => Math.max(1, Math.floor(side * scale)));
  Object.assign(element("frame").style, { width: `${w}px`, height: `${h}px` });
  document.body.style.setProperty("--below", `${(height - h) / 2}px`); // what the area leaves below the picture
  viewer.resize(w, h);
}

/** The line between the photo alone and the completed scene. */
export function divider(viewer) {
  const line = element("divider");
  const frame = element("frame");
  const move = (split) => viewer.setCompare(Math.min(Math.max(split, 0), 1));
  line.addEventListener("pointerdown", (event) => line.setPointerCapture(event.pointerId));
  line.addEventListener("pointermove", (event) => {
    const box = frame.getBoundingClientRect();
    if (line.hasPointerCapture(event.pointerId)) move((event.clientX - box.left) / box.width);
  });
  line.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, PageDown: -0.2, PageUp: 0.2, Home: -1, End: 1 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    move(viewer.stage.split + step);
  });
  viewer.addEventListener("change", () => {
    const { split } = viewer.stage;
    frame.classList.toggle("compare", split !== null);
    if (split === null) return;
    line.style.left = `${100 * split}%`;
    line.setAttribute("aria-valuenow", Math.round(100 * split));
  });
}

function press(id, on) {
  element(id).setAttribute("aria-pressed", on);
}

function pressed(id) {
  return element(id).getAttribute("aria-pressed") === "true";
}
