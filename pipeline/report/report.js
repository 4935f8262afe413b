"use strict";
(function () {
  const config = { displaylogo: false, responsive: true, modeBarButtonsToRemove: ["sendDataToCloud", "lasso2d", "select2d"] };
  const plots = Array.from(document.querySelectorAll(".plot"));
  document.documentElement.dataset.plots = String(plots.length);
  document.documentElement.dataset.drawn = "0";
  let drawn = 0;
  function draw(div) {
    if (div.dataset.state || typeof Plotly === "undefined") return Promise.resolve();
    div.dataset.state = "drawing";
    const figure = JSON.parse(div.parentNode.querySelector('script[type="application/json"]').textContent);
    return Plotly.newPlot(div, figure.data, figure.layout, config).then(function () {
      div.dataset.state = "drawn";
      drawn += 1;
      document.documentElement.dataset.drawn = String(drawn);
    });
  }
  // one after the other, so that the top of the page can be read at once
  function next(index) {
    if (index < plots.length) draw(plots[index]).then(function () { setTimeout(next, 0, index + 1); });
  }
  setTimeout(next, 0, 0);
  window.addEventListener("beforeprint", function () {
    document.querySelectorAll("details").forEach(function (d) { d.open = true; });
    if (typeof Plotly !== "undefined") plots.forEach(function (d) { if (d.dataset.state === "drawn") Plotly.Plots.resize(d); });
  });
  document.querySelectorAll("button.unfold").forEach(function (button) {
    button.addEventListener("click", function () {
      button.parentNode.classList.add("all");
      button.remove();
    });
  });
})();
