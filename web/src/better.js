// The button that has a better network fetched onto this machine.
import { better, fetchBetter } from "./source.js";

const LOOK_MS = 400; // between two looks at the progress

/**
 * Show what the server offers: {bytes, licence}, or null. `page` has say(line), and done(), which is called when the
 * network is here.
 */
export function offerBetter(button, offer, page) {
  button.hidden = !offer;
  if (!offer) return;
  const { bytes, licence } = offer;
  const name = `Better depth (${Math.round(bytes / 1e6) || "< 1"} MB, ${licence})`;
  button.textContent = name;
  button.title = "Fetches MoGe-2, a network that finds depth better than the one that is here, onto this machine";
  button.onclick = () => wait(fetchBetter);
  if (offer.state === "running") wait(better);

  async function wait(first) {
    button.disabled = true;
    try {
      let news = await first();
      while (news.state === "running") {
        button.textContent = `Better depth: ${Math.floor(100 * news.share)} %`;
        await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
        news = await better();
      }
      if (news.state !== "done") throw new Error(reason(news.error));
      button.hidden = true;
      await page.done();
    } catch (error) {
      page.say(`Better depth could not be fetched: ${error.message}`);
    }
    button.disabled = false;
    button.textContent = name;
  }
}

/** What went wrong, without the address and without advice for a terminal. */
function reason(line) {
  return line.replace(/^https?:\S+: /, "").split(": ")[0];
}
