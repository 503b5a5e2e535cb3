// The photos of this visit: they wait, one is worked on, and what is done can be looked at again.
const WORDS = { waiting: "waiting", working: "in work", done: "done", failed: "did not work" };

/**
 * A row of small pictures. An item is {name, file, options, url, id, state, line}: `file` and `options` of a photo
 * that is sent from here, `url` of its picture, `id` of its scene, `line` why it failed.
 *
 * `page` has work(item), which resolves when the scene is made; ended(item), which resolves when the page has told
 * so; pick(item) for a click; and stop(item).
 */
export class Queue {
  constructor(list, page) {
    Object.assign(this, { list, page, items: [], sending: null });
  }

  /** Let photos wait for their turn; they are sent one at a time. */
  add(photos) {
    for (const photo of photos) this.items.push({ id: null, line: "", ...photo, state: "waiting" });
    this.draw();
    this.next();
  }

  /** Follow a scene that the server has already, or works on. */
  adopt(scene) {
    const item = { file: null, url: null, line: "", name: "", ...scene, state: "working" };
    this.items.push(item);
    this.draw();
    return this.run(item);
  }

  withId(id) {
    return this.items.find((item) => item.id === id);
  }

  async next() {
    if (this.sending) return;
    const item = this.items.find(({ state }) => state === "waiting");
    if (!item) return;
    this.sending = item;
    item.state = "working";
    this.draw();
    await this.run(item);
    this.sending = null;
    this.next();
  }

  async run(item) {
    try {
      await this.page.work(item);
      item.state = "done";
    } catch (error) {
      Object.assign(item, { state: "failed", line: error.message });
    }
    if (item.stopped) this.drop(item);
    this.draw();
    await this.page.ended(item);
  }

  /** Take a photo out; the work on it ends. */
  remove(item) {
    if (item.state === "working") this.page.stop(item);
    else this.drop(item);
  }

  drop(item) {
    this.items = this.items.filter((other) => other !== item);
    if (item.url?.startsWith("blob:")) URL.revokeObjectURL(item.url);
    this.draw();
  }

  /** A single photo needs no row: the page shows it large. */
  draw() {
    this.list.hidden = this.items.length < 2;
    for (const item of this.items) this.update(item);
    this.list.replaceChildren(...this.items.map(({ element }) => element));
    this.page.resized();
  }

  update(item) {
    item.element ??= this.make(item);
    const { element, name, state, line, url } = item;
    element.className = state;
    element.title = line || `${name}: ${WORDS[state]}`;
    const [look, out] = element.querySelectorAll("button");
    look.setAttribute("aria-label", `${name}: ${WORDS[state]}`);
    look.setAttribute("aria-current", this.page.shows(item));
    out.setAttribute("aria-label", `Take ${name} out`);
    const image = look.firstChild;
    if (url && image.src !== url) image.src = url;
  }

  make(item) {
    const element = document.createElement("li");
    const look = Object.assign(document.createElement("button"), { type: "button", onclick: () => this.page.pick(item) });
    const out = Object.assign(document.createElement("button"), { type: "button", className: "out", textContent: "×" });
    out.onclick = () => this.remove(item);
    const image = Object.assign(document.createElement("img"), { alt: "" });
    // Not every browser shows every kind of photo; the server makes a JPEG of each.
    image.onerror = () => image.removeAttribute("src");
    look.append(image, document.createElement("i"));
    element.append(look, out);
    return element;
  }
}
