// Runs the viewer of a page that is sent, which is half as long compressed; the page's policy names it by its digest.
(async () => {
  const text = document.getElementById("spackle-viewer").textContent;
  const packed = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.body.append(script);
})().catch(() => {
  const notice = document.getElementById("notice");
  notice.querySelector("h2").textContent = "This page needs a newer browser";
  notice.hidden = false;
});
