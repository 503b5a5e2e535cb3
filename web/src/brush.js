// The brush with which a person marks what is to go: strokes on the picture, and their mask.
const element = (id) => document.getElementById(id);
const SMALLEST = 1; // diameters in percent of the picture's shorter side
const LARGEST = 40;

/** Strokes that a person paints; places and sizes are shares of the picture's width, so they outlive a resize. */
export class Brush extends EventTarget {
  constructor() {
    super();
    this.canvas = element("mask");
    this.ring = element("ring");
    this.slider = element("brush-size");
    this.strokes = [];
    this.stroke = null; // the one that is being painted
    this.listen();
  }

  listen() {
    const { canvas, slider } = this;
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button || this.stroke) return;
      canvas.setPointerCapture(event.pointerId);
      this.stroke = { size: this.size, points: [], pointer: event.pointerId };
      this.strokes.push(this.stroke);
      this.paint(event);
      this.changed();
    });
    canvas.addEventListener("pointermove", (event) => {
      this.showRing(event);
      if (this.stroke?.pointer === event.pointerId) this.paint(event);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(end, (event) => {
        if (this.stroke?.pointer === event.pointerId) this.stroke = null;
      });
    }
    canvas.addEventListener("pointerleave", () => (this.ring.hidden = true));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const larger = Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015));
      slider.value = Math.min(Math.max(slider.valueAsNumber * larger, SMALLEST), LARGEST);
      this.sized();
      this.showRing(event);
    }, { passive: false });
    slider.addEventListener("input", () => this.sized());
    new ResizeObserver(() => this.open && this.redraw()).observe(element("frame"));
    this.sized();
  }

  get open() {
    return !this.canvas.hidden;
  }

  /** The brush's diameter as a share of the picture's width. */
  get size() {
    const { clientWidth: width, clientHeight: height } = element("frame");
    return ((this.slider.valueAsNumber / 100) * Math.min(width, height)) / width;
  }

  start() {
    this.canvas.hidden = false;
    this.clear();
  }

  stop() {
    this.canvas.hidden = this.ring.hidden = true;
    this.clear();
  }

  clear() {
    this.strokes = [];
    this.stroke = null;
    this.redraw();
    this.changed();
  }

  /** Take the last stroke back. */
  undo() {
    this.strokes.pop();
    this.stroke = null;
    this.redraw();
    this.changed();
  }

  changed() {
    this.dispatchEvent(new Event("change"));
  }

  sized() {
    const share = (this.slider.valueAsNumber - SMALLEST) / (LARGEST - SMALLEST);
    this.slider.style.setProperty("--at", `${100 * share}%`);
    this.slider.setAttribute("aria-valuetext", `${Math.round(this.slider.valueAsNumber)} % of the picture`);
  }

  paint(event) {
    const box = this.canvas.getBoundingClientRect();
    const events = event.getCoalescedEvents?.() ?? [];
    for (const { clientX, clientY } of events.length ? events : [event]) {
      this.stroke.points.push([(clientX - box.left) / box.width, (clientY - box.top) / box.width]);
    }
    draw(this.context(), this.stroke, this.canvas.width);
  }

  /** A circle as large as the brush follows the pointer; a finger needs none. */
  showRing({ clientX, clientY, pointerType }) {
    const box = element("frame").getBoundingClientRect();
    const diameter = this.size * box.width;
    this.ring.hidden = pointerType === "touch";
    Object.assign(this.ring.style, {
      left: `${clientX - box.left}px`, top: `${clientY - box.top}px`, width: `${diameter}px`, height: `${diameter}px`,
    });
  }

  redraw() {
    const { clientWidth: width, clientHeight: height } = element("frame");
    Object.assign(this.canvas, { width, height });
    for (const stroke of this.strokes) draw(this.context(), stroke, width);
  }

  context() {
    const context = this.canvas.getContext("2d");
    context.strokeStyle = context.fillStyle = getComputedStyle(this.canvas).color;
    return context;
  }

  /** The marked places as a PNG of this size: white on black. */
  async mask(width, height) {
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const context = canvas.getContext("2d");
    context.fillRect(0, 0, width, height);
    context.strokeStyle = context.fillStyle = "white";
    for (const stroke of this.strokes) draw(context, stroke, width);
    return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
  }
}

/** One stroke on a canvas whose picture is `width` pixels wide. */
function draw(context, { size, points }, width) {
  const [first, ...others] = points.map(([x, y]) => [x * width, y * width]);
  if (!first) return;
  context.beginPath();
  context.arc(...first, (size * width) / 2, 0, 2 * Math.PI);
  context.fill();
  context.beginPath();
  context.moveTo(...first);
  for (const point of others) context.lineTo(...point);
  Object.assign(context, { lineWidth: size * width, lineCap: "round", lineJoin: "round" });
  context.stroke();
}
