// Tiles in Web Mercator under the map, which lies in metres of its own frame.

const MOST = 400; // tiles that are kept
const FINEST = 21; // level of tiles that are asked for
const WORLD_M = 40075016.7; // side of Web Mercator's square

export class Tiles {
  // `geodetic` gives latitude and longitude of a place of the map.
  constructor(geodetic, changed, failed) {
    Object.assign(this, { geodetic, changed, failed, tiles: new Map() });
  }

  // Share of Web Mercator's square, from the north-west, of a place of the map.
  share([x, y]) {
    const [latitude, longitude] = this.geodetic(x, y);
    return [longitude / 360 + 0.5, (1 - Math.asinh(Math.tan(latitude * Math.PI / 180)) / Math.PI) / 2];
  }

  // The place of the map at a share, by Newton's method from a place near it.
  place(wanted, start) {
    let [x, y] = start;
    for (let round = 0; round < 4; round++) {
      const at = this.share([x, y]);
      const [[ax, ay], [bx, by]] = [this.share([x + 1, y]), this.share([x, y + 1])].map((other) => [other[0] - at[0], other[1] - at[1]]);
      const [dx, dy] = [wanted[0] - at[0], wanted[1] - at[1]];
      const area = ax * by - bx * ay;
      x += (dx * by - dy * bx) / area;
      y += (ax * dy - ay * dx) / area;
    }
    return [x, y];
  }

  draw(context, view) {
    const middle = [view.east, view.north];
    const [latitude] = this.geodetic(...middle);
    const level = Math.max(1, Math.min(FINEST, Math.ceil(Math.log2(view.scale * WORLD_M * Math.cos(latitude * Math.PI / 180) / 256) - 0.3)));
    const count = 2 ** level;
    const [west, south, east, north] = view.box();
    const shares = [[west, south], [west, north], [east, south], [east, north]].map((place) => this.share(place));
    const [columns, rows] = [0, 1].map((axis) => shares.map((share) => Math.floor(share[axis] * count)));
    for (let column = Math.min(...columns); column <= Math.max(...columns); column++) {
      for (let row = Math.min(...rows); row <= Math.max(...rows); row++) this.tile(context, view, level, column, row, middle);
    }
  }

  tile(context, view, level, column, row, middle) {
    const key = `${level}/${column}/${row}`;
    if (!this.tiles.has(key)) {
      const picture = new Image();
      picture.onload = this.changed;
      picture.onerror = () => this.failed();
      picture.src = `background/${key}`;
      this.tiles.set(key, picture);
      if (this.tiles.size > MOST) this.tiles.delete(this.tiles.keys().next().value);
    }
    const picture = this.tiles.get(key);
    if (!picture.complete || !picture.naturalWidth) return;
    const count = 2 ** level;
    const corner = (right, down) => view.toScreen(this.place([(column + right) / count, (row + down) / count], middle));
    const [[ox, oy], [ax, ay], [bx, by]] = [corner(0, 0), corner(1, 0), corner(0, 1)];
    const [width, height] = [picture.naturalWidth, picture.naturalHeight];
    context.save();
    context.transform((ax - ox) / width, (ay - oy) / width, (bx - ox) / height, (by - oy) / height, ox, oy);
    context.drawImage(picture, 0, 0, width + 0.5, height + 0.5); // without seams
    context.restore();
  }
}
