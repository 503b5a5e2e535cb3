// Mouse, fingers and keys on the picture.
const REACH = 1.6; // disparities for a pull across the whole picture
const STEP = 0.05; // disparities for a key

export function control(canvas, viewer) {
  const pointers = new Map();

  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, event);
    canvas.classList.add("held");
  });
  canvas.addEventListener("pointermove", (event) => {
    const before = pointers.get(event.pointerId);
    if (!before || !viewer.description) return;
    if (pointers.size === 1 && event.buttons !== 2 && !event.shiftKey) orbit(before, event);
    else if (pointers.size === 1) shift(before, event, 1);
    else if (pointers.size === 2) pinch(before, event);
    pointers.set(event.pointerId, event);
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => {
      pointers.delete(event.pointerId);
      viewer.release();
      if (!pointers.size) canvas.classList.remove("held");
    });
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => viewer.home());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    if (viewer.description) viewer.zoomAt(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...place(event));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    const act = viewer.description && !event.ctrlKey && !event.metaKey && !event.altKey && keys[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });

  const keys = {
    ArrowLeft: () => nudge(-STEP, 0),
    ArrowRight: () => nudge(STEP, 0),
    ArrowUp: () => nudge(0, -STEP),
    ArrowDown: () => nudge(0, STEP),
    "+": () => viewer.zoomAt(1.15, 0, 0),
    "=": () => viewer.zoomAt(1.15, 0, 0),
    "-": () => viewer.zoomAt(1 / 1.15, 0, 0),
    "0": () => viewer.home(),
    Home: () => viewer.home(),
  };

  // Space plays from anywhere, but where it types, or presses what has the focus.
  addEventListener("keydown", (event) => {
    const isTaken = event.target.closest?.("button, summary, select, textarea, a, input:not([type=range])");
    if (event.key !== " " || isTaken || canvas.inert || !viewer.description || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    if (viewer.playing) viewer.pause();
    else viewer.play();
  });

  function nudge(dx, dy) {
    viewer.pull(dx, dy);
    viewer.release();
  }

  /** What the hand holds follows it: the eye goes the other way. */
  function orbit(from, to) {
    const size = REACH / canvas.clientWidth / viewer.stage.zoom.scale;
    viewer.pull((from.clientX - to.clientX) * size, (from.clientY - to.clientY) * size);
  }

  function shift(from, to, share) {
    const [a, b] = [place(from), place(to)];
    viewer.shift((b[0] - a[0]) * share, (b[1] - a[1]) * share);
  }

  function pinch(from, to) {
    const [, other] = [...pointers].find(([id]) => id !== to.pointerId);
    const [before, after] = [from, to].map((event) => Math.hypot(event.clientX - other.clientX, event.clientY - other.clientY));
    const [a, b] = [place(to), place(other)];
    shift(from, to, 0.5);
    viewer.zoomAt(after / Math.max(before, 1), (a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
  }

  /** In -1..1 of the canvas, y up. */
  function place(event) {
    const box = canvas.getBoundingClientRect();
    return [(2 * (event.clientX - box.left)) / box.width - 1, 1 - (2 * (event.clientY - box.top)) / box.height];
  }
}
