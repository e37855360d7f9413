"use strict";
// Under the pointer, every chart shows the values of its curves.
(() => {
  const SVG = "http://www.w3.org/2000/svg";

  function nearestIndex(values, x) {
    let best = 0;
    for (let i = 1; i < values.length; i++) if (Math.abs(values[i] - x) < Math.abs(values[best] - x)) best = i;
    return best;
  }

  function bind(figure) {
    const svg = figure.querySelector("svg[role='img']"), data = figure.querySelector("script");
    if (!svg || !data) return;
    const curves = JSON.parse(data.textContent).filter((curve) => curve.x.length);
    const tip = document.createElement("div");
    tip.className = "chart-tip"; tip.hidden = true; figure.append(tip);
    const dots = curves.map((curve) => {
      const dot = document.createElementNS(SVG, "circle");
      dot.setAttribute("r", 4); dot.setAttribute("fill", curve.color); dot.style.display = "none";
      return svg.appendChild(dot);
    });
    svg.addEventListener("pointermove", (event) => {
      const box = svg.getBoundingClientRect(), x = ((event.clientX - box.left) / box.width) * svg.viewBox.baseVal.width;
      tip.replaceChildren();
      curves.forEach((curve, i) => {
        const at = nearestIndex(curve.x, x), row = document.createElement("div");
        dots[i].setAttribute("cx", curve.x[at]); dots[i].setAttribute("cy", curve.y[at]); dots[i].style.display = "";
        row.textContent = `${curves.length > 1 ? curve.name + " " : ""}${curve.value[at]} at ${curve.at[at]}`;
        tip.append(row);
      });
      tip.hidden = false;
    });
    svg.addEventListener("pointerleave", () => { tip.hidden = true; dots.forEach((dot) => { dot.style.display = "none"; }); });
  }

  document.querySelectorAll("figure.chart").forEach(bind);
})();
