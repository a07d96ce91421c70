// Points and lines in space, turned by dragging; orthographic. The axes are Sensor's
// (x right, y down, z away), or with z up (x right, y away).
function drawScenes() {
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const floats = (text) => new Float32Array(bytes(text).buffer);
  for (const canvas of document.querySelectorAll("canvas.scene")) {
    const data = canvas.dataset;
    const points = floats(data.points), colours = bytes(data.colours);
    const lines = floats(data.lines), lineColours = bytes(data.lineColours);
    const centre = floats(data.centre);
    const ink = "#5d6b7a", labels = JSON.parse(data.labels);
    const told = data.told ? JSON.parse(data.told) : [], values = told.length ? floats(data.values) : null;
    let picked = -1, moved = 0;
    let yaw = Number(data.yaw), pitch = Number(data.pitch), zoom = 1, reach = null;

    function turned() {
      const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
      const seen = (x, y, z) => [cy * x + sy * z, cp * y - sp * (cy * z - sy * x)];
      return data.up === "z" ? (x, y, z) => seen(x, -z, y) : seen;
    }

    // how far behind the middle a point lies: of dots in one place, the one in front is seen
    function depthOf() {
      const [cy, sy, cp, sp] = [Math.cos(yaw), Math.sin(yaw), Math.cos(pitch), Math.sin(pitch)];
      const depth = (x, y, z) => cp * (cy * z - sy * x) + sp * y;
      return data.up === "z" ? (x, y, z) => depth(x, -z, y) : depth;
    }

    function reachOf(turn) {
      let [wide, high] = [1e-6, 1e-6];
      for (const values of [points, lines]) for (let k = 0; k < values.length; k += 3) {
        const [x, y] = turn(values[k] - centre[0], values[k + 1] - centre[1], values[k + 2] - centre[2]);
        wide = Math.max(wide, Math.abs(x));
        high = Math.max(high, Math.abs(y));
      }
      return [wide, high];
    }

    function draw() {
      const ratio = window.devicePixelRatio || 1;
      const width = (canvas.width = Math.round(canvas.clientWidth * ratio));
      const height = (canvas.height = Math.round(canvas.clientHeight * ratio));
      // not laid out yet, or in a part that is folded
      if (!width || !height) return;
      const context = canvas.getContext("2d", { willReadFrequently: true });
      const turn = turned();
      reach = reach || reachOf(turn);
      const scale = zoom * 0.44 * Math.min(width / reach[0], height / reach[1]);
      const place = (values, k) => {
        const [x, y] = turn(values[k] - centre[0], values[k + 1] - centre[1], values[k + 2] - centre[2]);
        return [width / 2 + scale * x, height / 2 + scale * y];
      };
      context.fillStyle = "#fff";
      context.fillRect(0, 0, width, height);
      context.lineWidth = 1.2 * ratio;
      for (let k = 0; k < lines.length; k += 6) {
        const c = k / 2;
        context.strokeStyle = `rgb(${lineColours[c]} ${lineColours[c + 1]} ${lineColours[c + 2]})`;
        context.beginPath();
        context.moveTo(...place(lines, k));
        context.lineTo(...place(lines, k + 3));
        context.stroke();
      }
      const image = context.getImageData(0, 0, width, height), pixels = image.data;
      // few points are drawn larger, or nothing is seen of a surface
      const larger = Math.min(3, Math.max(1, Math.sqrt(12000 / Math.max(points.length, 1))));
      const size = Math.max(2, Math.round((values ? 2.4 : 1.6) * larger * ratio));
      const depths = new Float32Array(width * height).fill(Infinity), depthAt = depthOf();
      for (let k = 0; k < points.length; k += 3) {
        const [px, py] = place(points, k).map((at) => Math.round(at - (size - 1) / 2));
        const depth = depthAt(points[k] - centre[0], points[k + 1] - centre[1], points[k + 2] - centre[2]);
        for (let j = py; j < py + size; j++) for (let i = px; i < px + size; i++) {
          if (i < 0 || j < 0 || i >= width || j >= height) continue;
          if (depth >= depths[j * width + i]) continue;
          depths[j * width + i] = depth;
          const q = 4 * (j * width + i);
          pixels[q] = colours[k]; pixels[q + 1] = colours[k + 1]; pixels[q + 2] = colours[k + 2];
        }
      }
      context.putImageData(image, 0, 0);
      context.font = `${12 * ratio}px sans-serif`;
      context.fillStyle = ink;
      // a pale rim keeps a label readable where lines cross it
      context.strokeStyle = "rgba(255, 255, 255, 0.9)";
      context.lineWidth = 4 * ratio;
      // one label where several would lie on each other; turning the scene shows the others
      const drawn = [];
      for (const [text, ...at] of labels) {
        const [x, y] = place(at, 0), wide = context.measureText(text).width, high = 14 * ratio;
        if (drawn.some(([left, top, size]) =>
          x < left + size && left < x + wide && Math.abs(y - top) < high)) continue;
        drawn.push([x, y, wide]);
        context.strokeText(text, x, y);
        context.fillText(text, x, y);
      }
      if (picked >= 0) drawPicked(context, place(points, 3 * picked), width, ratio);
      drawAxes(context, turn, 46 * ratio, height - 46 * ratio, 30 * ratio, ratio);
      drawBar(context, width, height, scale, ratio);
    }

    // what a dot is, beside a ring about it
    function drawPicked(context, [px, py], width, ratio) {
      const row = values.subarray(told.length * picked, told.length * (picked + 1));
      const lines = told.map(([name, names], k) =>
        `${name}: ${names ? names[row[k]] || "-" : isNaN(row[k]) ? "not known" : row[k].toFixed(4)}`);
      context.strokeStyle = context.fillStyle = "#000";
      context.lineWidth = 2 * ratio;
      context.beginPath();
      context.arc(px, py, 6 * ratio, 0, 7);
      context.stroke();
      const wide = Math.max(...lines.map((line) => context.measureText(line).width)) + 16 * ratio;
      const left = Math.max(0, Math.min(px + 12 * ratio, width - wide)), top = Math.max(0, py - 50 * ratio);
      context.fillStyle = "rgba(255, 255, 255, 0.94)";
      context.fillRect(left, top, wide, (16 * lines.length + 10) * ratio);
      context.lineWidth = ratio;
      context.strokeRect(left, top, wide, (16 * lines.length + 10) * ratio);
      context.fillStyle = "#1d2733";
      lines.forEach((line, k) => context.fillText(line, left + 8 * ratio, top + 16 * (k + 1) * ratio));
    }

    // the dot nearest to a click; of those as near, the one in front
    function pick(event) {
      const box = canvas.getBoundingClientRect(), scale = zoom * 0.44 * Math.min(box.width / reach[0], box.height / reach[1]);
      const turn = turned(), depthAt = depthOf();
      let best = 12;
      picked = -1;
      let front = Infinity;
      for (let k = 0; k < points.length; k += 3) {
        const d = [points[k] - centre[0], points[k + 1] - centre[1], points[k + 2] - centre[2]];
        const [x, y] = turn(...d);
        const off = Math.hypot(box.width / 2 + scale * x - (event.clientX - box.left), box.height / 2 + scale * y - (event.clientY - box.top));
        const depth = depthAt(...d), near = off < 3 ? 3 : off;
        if (near < best || (near === best && depth < front)) { best = near; front = depth; picked = k / 3; }
      }
      draw();
    }

    function drawAxes(context, turn, x0, y0, length, ratio) {
      context.lineWidth = 1.5 * ratio;
      context.strokeStyle = ink;
      for (const [name, axis] of [["X", [1, 0, 0]], ["Y", [0, 1, 0]], ["Z", [0, 0, 1]]]) {
        const [dx, dy] = turn(...axis);
        context.beginPath();
        context.moveTo(x0, y0);
        context.lineTo(x0 + length * dx, y0 + length * dy);
        context.stroke();
        context.fillText(name, x0 + 1.25 * length * dx - 4 * ratio, y0 + 1.25 * length * dy + 4 * ratio);
      }
    }

    function drawBar(context, width, height, scale, ratio) {
      const wanted = (110 * ratio) / scale, power = 10 ** Math.floor(Math.log10(wanted));
      const length = power * [5, 2, 1].find((step) => step * power <= wanted);
      const right = width - 18 * ratio, y = height - 18 * ratio;
      context.fillRect(right - scale * length, y, scale * length, 2 * ratio);
      context.textAlign = "right";
      context.fillText(`${Number(length.toPrecision(1))} mm`, right, y - 6 * ratio);
      context.textAlign = "left";
    }

    canvas.addEventListener("pointerdown", (event) => { moved = 0; canvas.setPointerCapture(event.pointerId); });
    canvas.addEventListener("pointerup", (event) => { if (values && moved < 4) pick(event); });
    canvas.addEventListener("pointermove", (event) => {
      if (!event.buttons) return;
      moved += Math.abs(event.movementX) + Math.abs(event.movementY);
      yaw -= event.movementX / 160;
      pitch = Math.max(-1.57, Math.min(1.57, pitch - event.movementY / 160));
      draw();
    });
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas) return;
      event.preventDefault();
      zoom = Math.max(0.3, Math.min(40, zoom * Math.exp(-event.deltaY / 500)));
      draw();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const steps = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
      const step = steps[event.key];
      if (!step) return;
      event.preventDefault();
      yaw += step[0];
      pitch += step[1];
      draw();
    });
    window.addEventListener("resize", draw);
    draw();
  }
}
drawScenes();
