// A slider: the left picture is cut off where the slider stands.
for (const slider of document.querySelectorAll(".slider")) {
  const stage = slider.querySelector(".stage");
  const range = slider.querySelector("input");
  const layers = [...slider.querySelectorAll(".layer")];
  range.addEventListener("input", () => stage.style.setProperty("--at", range.value + "%"));
  for (const select of slider.querySelectorAll("select")) {
    const side = select.dataset.side;
    select.addEventListener("change", () => {
      layers.forEach((layer, number) => layer.classList.toggle(side, number === Number(select.value)));
    });
  }
}
