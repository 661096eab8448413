// Thousands of outlines, lines and circles on one canvas of Leaflet. They are drawn by looks, a path for hundreds of them at
// once, and small ones as dots; Leaflet moves the canvas while the map is panned.
const Features = (() => {
  "use strict";
  const AT_ONCE = 400; // shapes of a path: longer paths take a browser more than twice as long; chosen
  const DOT_PX = 4; // an outline that is smaller is drawn as a dot; chosen
  const STEP_PX = 0.7; // vertices of a line that lie nearer are left out; chosen
  const NEAR_PX = 3; // how far beside a circle or a dot it is hit; chosen

  const boxOf = (points) => {
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [x, y] of points) {
      if (x < box[0]) box[0] = x;
      if (y < box[1]) box[1] = y;
      if (x > box[2]) box[2] = x;
      if (y > box[3]) box[3] = y;
    }
    return box;
  };
  const boundsOf = ([west, south, east, north]) => L.latLngBounds([[south, west], [north, east]]);
  const holds = (points, x, y) => {
    let isInside = false;
    for (let n = 0, m = points.length - 1; n < points.length; m = n++) {
      const [[ax, ay], [bx, by]] = [points[n], points[m]];
      if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) isInside = !isInside;
    }
    return isInside;
  };

  // A shape: `points` of an outline, or of an open line; or an `ellipse` [x, y, a, b, direction]; or a circle about its only
  // point, of `radius` pixels. `about` is what it stands for, `look` how it is drawn.
  class Shape {
    constructor(points, more = {}) {
      Object.assign(this, { points, about: null, isOpen: false, look: null }, more);
      this.box = boxOf(points);
      if (this.ellipse) {
        const [x, y, a] = this.ellipse;
        this.box = [x - a, y - a, x + a, y + a];
      }
    }

    getBounds() {
      return boundsOf(this.box);
    }

    isDot(px) {
      const [west, south, east, north] = this.box;
      return this.radius === undefined && Math.max(east - west, north - south) * px < DOT_PX;
    }

    isHit(x, y, px) {
      const [west, south, east, north] = this.box;
      const isDot = this.isDot(px);
      const by = (this.radius ?? 0) / px + (isDot || this.radius !== undefined ? NEAR_PX / px : 0);
      if (x < west - by || x > east + by || y < south - by || y > north + by) return false;
      if (this.radius !== undefined) return Math.hypot(x - west, y - south) <= by;
      return isDot || holds(this.points, x, y);
    }
  }

  // A layer of shapes, which a map shows or not.
  const Group = L.Layer.extend({
    initialize(canvas, shapes = [], isInteractive = false) {
      Object.assign(this, { canvas, shapes, isInteractive });
    },
    onAdd() { this.canvas.redraw(); },
    onRemove() { this.canvas.redraw(); },
    getBounds() {
      const bounds = L.latLngBounds([]);
      for (const shape of this.shapes) bounds.extend(shape.getBounds());
      return bounds;
    },
    replace(shapes) {
      this.shapes = shapes;
      this.canvas.redraw();
    },
    // Shapes that look alike follow each other, for a path each; areas lie below what is in them.
    restyle(lookOf) {
      const looks = new Map();
      for (const shape of this.shapes) {
        const look = lookOf(shape);
        const key = JSON.stringify(look);
        if (!looks.has(key)) looks.set(key, { ...look, order: looks.size });
        shape.look = looks.get(key);
      }
      const isArea = (shape) => (shape.about?.area ? 1 : 0);
      this.shapes.sort((a, b) => isArea(b) - isArea(a) || a.look.order - b.look.order);
      this.canvas.redraw();
    },
  });

  const Canvas = L.Renderer.extend({
    groups: null, // from below to above
    getEvents() {
      return { ...L.Renderer.prototype.getEvents.call(this), move: this._onMove };
    },
    _initContainer() {
      this._container = document.createElement("canvas");
    },
    _destroyContainer() {
      cancelAnimationFrame(this.frame);
      this._container.remove();
      delete this._container;
    },
    _update() {
      if (this._map._animatingZoom && this._bounds) return;
      L.Renderer.prototype._update.call(this);
      const { _container: canvas, _bounds: bounds } = this;
      const size = bounds.getSize();
      const ratio = Math.min(devicePixelRatio || 1, 2);
      L.DomUtil.setPosition(canvas, bounds.min);
      const [width, height] = [Math.round(ratio * size.x), Math.round(ratio * size.y)];
      if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
      [canvas.style.width, canvas.style.height] = [`${size.x}px`, `${size.y}px`];
      this.ratio = ratio;
      this.redraw();
    },
    _onMove() { // beyond what is drawn
      if (this._map._animatingZoom) return;
      const size = this._map.getSize();
      const [first, last] = [L.point(0, 0), size].map((corner) => this._map.containerPointToLayerPoint(corner));
      if (!this._bounds.contains([first, last])) this._update();
    },
    redraw() {
      if (!this._map) return;
      cancelAnimationFrame(this.frame);
      this.frame = requestAnimationFrame(() => this.draw());
    },
    draw() {
      const { _container: canvas, _bounds: bounds, _map: map, ratio } = this;
      const context = canvas.getContext("2d");
      const px = map.options.crs.scale(this._zoom);
      const origin = map.getPixelOrigin();
      const [left, top] = [-origin.x - bounds.min.x, -origin.y - bounds.min.y];
      context.setTransform(1, 0, 0, 1, 0, 0);
      context.clearRect(0, 0, canvas.width, canvas.height);
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      const size = bounds.getSize();
      const view = { px, left, top, box: [-left / px, (top - size.y) / px, (size.x - left) / px, top / px] };
      for (const group of this.groups) if (map.hasLayer(group)) drawGroup(context, group, view);
    },
    // The shape on top at a place, of groups that react to the pointer.
    hit({ lat, lng }) {
      const px = this._map.options.crs.scale(this._zoom);
      for (let n = this.groups.length - 1; n >= 0; n--) {
        const { shapes, isInteractive } = this.groups[n];
        if (!isInteractive || !this._map.hasLayer(this.groups[n])) continue;
        for (let m = shapes.length - 1; m >= 0; m--) if (shapes[m].about && shapes[m].isHit(lng, lat, px)) return shapes[m];
      }
      return null;
    },
  });

  function drawGroup(context, { shapes }, view) {
    const [west, south, east, north] = view.box;
    let [look, run] = [null, []];
    for (const shape of shapes) {
      const box = shape.box;
      if (box[2] < west || box[0] > east || box[3] < south || box[1] > north || !shape.look) continue;
      if (shape.look !== look || run.length === AT_ONCE) {
        drawRun(context, run, look, view);
        [look, run] = [shape.look, []];
      }
      run.push(shape);
    }
    drawRun(context, run, look, view);
  }

  // Shapes of one look. A look is {color, weight, dash, fill, opacity}.
  function drawRun(context, run, look, view) {
    if (!run.length) return;
    const path = new Path2D();
    let isPath = false;
    context.fillStyle = look.color;
    for (const shape of run) {
      if (shape.isDot(view.px)) dot(context, shape.box, view);
      else {
        trace(path, shape, view);
        isPath = true;
      }
    }
    if (!isPath) return;
    if (look.opacity) {
      context.fillStyle = look.fill ?? look.color;
      context.globalAlpha = look.opacity;
      context.fill(path);
      context.globalAlpha = 1;
    }
    context.strokeStyle = look.color;
    context.lineWidth = look.weight;
    context.lineJoin = context.lineCap = "round";
    context.setLineDash(look.dash ?? []);
    context.stroke(path);
  }

  function dot(context, box, { px, left, top }) {
    const [width, height] = [Math.max((box[2] - box[0]) * px, 1.5), Math.max((box[3] - box[1]) * px, 1.5)];
    context.fillRect(left + box[0] * px, top - box[3] * px, width, height);
  }

  function trace(path, { points, isOpen, ellipse, radius }, { px, left, top }) {
    if (ellipse) {
      const [x, y, a, b, direction] = ellipse;
      path.moveTo(left + (x + a * Math.cos(direction)) * px, top - (y + a * Math.sin(direction)) * px);
      path.ellipse(left + x * px, top - y * px, a * px, b * px, -direction, 0, 2 * Math.PI);
      return;
    }
    let [u, v] = [left + points[0][0] * px, top - points[0][1] * px];
    if (radius !== undefined) {
      path.moveTo(u + radius, v);
      path.arc(u, v, radius, 0, 2 * Math.PI);
      return;
    }
    path.moveTo(u, v);
    for (let n = 1; n < points.length; n++) {
      const [x, y] = [left + points[n][0] * px, top - points[n][1] * px];
      if (isOpen && n < points.length - 1 && Math.abs(x - u) + Math.abs(y - v) < STEP_PX) continue;
      path.lineTo(x, y);
      [u, v] = [x, y];
    }
    if (!isOpen) path.closePath();
  }

  return { Canvas, Group, Shape };
})();
