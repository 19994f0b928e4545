// Values under the pointer: each plot carries its numbers in data-plot.
(function () {
  "use strict";
  const SVG = "http://www.w3.org/2000/svg";
  function format(v) {
    if (v === null || v === undefined) return "–";
    const a = Math.abs(v);
    return a !== 0 && (a >= 1e5 || a < 1e-3) ? v.toExponential(2) : String(Number(v.toPrecision(4)));
  }
  function nearest(xs, x) {
    let lo = 0, hi = xs.length - 1;
    while (hi - lo > 1) {
      const mid = (lo + hi) >> 1;
      if (xs[mid] < x) lo = mid; else hi = mid;
    }
    return Math.abs(xs[lo] - x) <= Math.abs(xs[hi] - x) ? lo : hi;
  }
  document.querySelectorAll("svg[data-plot]").forEach(function (svg) {
    const plot = JSON.parse(svg.dataset.plot);
    const [left, right, top, bottom] = plot.box, [x0, x1] = plot.x;
    const cursor = document.createElementNS(SVG, "line");
    cursor.setAttribute("class", "cursor");
    cursor.setAttribute("y1", top);
    cursor.setAttribute("y2", bottom);
    cursor.style.display = "none";
    svg.appendChild(cursor);
    const readout = document.createElement("div");
    readout.className = "readout";
    readout.hidden = true;
    svg.parentElement.appendChild(readout);
    svg.addEventListener("pointermove", function (event) {
      const box = svg.getBoundingClientRect();
      const px = (event.clientX - box.left) / box.width * svg.viewBox.baseVal.width;
      const inside = px >= left && px <= right;
      cursor.style.display = inside ? "" : "none";
      readout.hidden = !inside;
      if (!inside) return;
      const x = x0 + (px - left) / (right - left) * (x1 - x0);
      cursor.setAttribute("x1", px);
      cursor.setAttribute("x2", px);
      readout.textContent = plot.xLabel + " " + format(x) + " · " + plot.series.map(function (s) {
        const y = format(s.y[nearest(s.x, x)]);
        return plot.series.length > 1 ? s.name + " " + y : y;
      }).join(" · ");
    });
    svg.addEventListener("pointerleave", function () {
      cursor.style.display = "none";
      readout.hidden = true;
    });
  });
})();
