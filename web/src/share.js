// One dialog for everything that can be sent: a video in the shape of where it goes, a page, a link.
import { download, fileName } from "./save.js";
import { fetched, howFar, link } from "./source.js";

const FORM = `<form method="dialog">
  <h2>Share</h2>
  <fieldset>
    <label class="story"><input type="radio" name="what" value="story" checked><i></i>Story</label>
    <label class="square"><input type="radio" name="what" value="square"><i></i>Square</label>
    <label class="wide-shape"><input type="radio" name="what" value="wide"><i></i>Wide</label>
    <label class="page"><input type="radio" name="what" value="scene"><i></i>Page</label>
  </fieldset>
  <fieldset class="few" id="share-format">
    <label><input type="radio" name="format" value=".mp4" checked>Video (MP4)</label>
    <label><input type="radio" name="format" value=".gif">GIF, small</label>
  </fieldset>
  <p><input name="caption" maxlength="200" placeholder="A caption, if you like" aria-label="Caption" autocomplete="off"></p>
  <p class="line" role="status"></p>
  <progress aria-label="In work" hidden></progress>
  <menu>
    <button type="button" value="link">Copy link</button>
    <button type="button" value="close">Close</button>
    <button type="button" value="send">Send…</button>
    <button type="button" value="save" class="main">Save</button>
  </menu>
</form>`;
const LINES = {
  video: "Five seconds, made on the computer where Spackle runs: it takes up to a few minutes.",
  page: "One file that shows the picture and its motion; it opens in every browser.",
};
const TYPES = { ".mp4": "video/mp4", ".gif": "image/gif", ".html": "text/html" };

export function sharing(viewer, say) {
  const button = document.getElementById("share");
  const dialog = Object.assign(document.createElement("dialog"), { id: "sharing", innerHTML: FORM });
  dialog.setAttribute("aria-label", "Share");
  const form = dialog.querySelector("form");
  const { what, format, caption } = form.elements;
  const line = dialog.querySelector(".line");
  const progress = dialog.querySelector("progress");
  const does = (value) => dialog.querySelector(`button[value=${value}]`);
  let last = { key: null, file: null }; // what was made last, so that it is not made twice
  document.body.append(dialog);

  viewer.addEventListener("change", () => (button.hidden = !viewer.id)); // the server makes what is sent
  button.onclick = () => {
    update();
    dialog.showModal();
  };
  form.onchange = update;
  form.onsubmit = (event) => event.preventDefault();
  does("close").onclick = () => dialog.close();
  does("save").onclick = () => work(async () => {
    const file = await made();
    download(file, file.name);
    line.textContent = `Saved: ${file.name}`;
  });
  does("send").onclick = () => work(async () => send(await made()));
  does("link").onclick = () => work(async () => {
    const address = await link(viewer.id, what.value === "scene" ? caption.value.trim() : "");
    await copied(address ?? location.href);
    line.textContent = "The link is copied. Who has it sees this scene, and nothing else, while Spackle runs.";
  });

  function update() {
    const isPage = what.value === "scene";
    document.getElementById("share-format").hidden = isPage;
    caption.parentElement.hidden = !isPage;
    line.textContent = isPage ? LINES.page : LINES.video;
    does("link").hidden = !reachable(location.hostname);
    const sample = new File(["0"], `a${suffix()}`, { type: TYPES[suffix()] });
    does("send").hidden = !navigator.canShare?.({ files: [sample] });
  }

  function suffix() {
    return what.value === "scene" ? ".html" : format.value;
  }

  /** What is chosen, as a file; from the server, if it is not the one that was made last. */
  async function made() {
    const key = [viewer.id, what.value, suffix(), caption.value].join("\n");
    if (last.key === key) return last.file;
    const blob = await fetched(viewer.id, `${what.value}${suffix()}`, suffix() === ".html" ? caption.value.trim() : "", tell);
    const shape = what.value === "scene" ? "" : `-${what.value}`;
    last = { key, file: new File([blob], `${fileName(viewer)}${shape}${suffix()}`, { type: TYPES[suffix()] }) };
    return last.file;
  }

  /** Show how far the file is that the server makes. */
  function tell(news) {
    line.textContent = `Making ${what.value === "scene" ? "the page" : "the video"}${howFar(news)}`;
    if (news.share === null) progress.removeAttribute("value");
    else progress.value = news.share;
  }

  async function send(file) {
    try {
      await navigator.share({ files: [file], title: fileName(viewer) });
      line.textContent = "Sent.";
    } catch (error) {
      if (error.name === "AbortError") return; // who has changed his mind knows it
      if (error.name !== "NotAllowedError") throw error;
      line.textContent = "Ready: press Send once more."; // a browser lets a page send soon after a click alone
    }
  }

  async function work(task) {
    const controls = form.querySelectorAll("button:not([value=close]), input");
    for (const each of controls) each.disabled = true;
    progress.removeAttribute("value");
    progress.hidden = false;
    try {
      await task();
      if (!dialog.open && line.textContent) say(line.textContent);
    } catch (error) {
      line.textContent = `That did not work: ${error.message}`;
      if (!dialog.open) say(line.textContent);
    }
    progress.hidden = true;
    for (const each of controls) each.disabled = false;
  }
}

/** Whether somebody on another machine can open an address at this host. */
function reachable(host) {
  return !/^(localhost|.*\.localhost|127\..*|\[::1\])$/.test(host);
}

/** Put a text into the clipboard; an address without encryption may not use the newer way. */
async function copied(text) {
  if (navigator.clipboard) return navigator.clipboard.writeText(text);
  const field = Object.assign(document.createElement("textarea"), { value: text });
  document.querySelector("#sharing").append(field);
  field.select();
  const done = document.execCommand("copy");
  field.remove();
  if (!done) throw new Error(`copy it from the address bar: ${text}`);
}
