"use strict";
/* The cameras' pictures, decoded when their frame's turn comes; few frames are kept at a time. */

class Pictures {
  constructor(onReady) {
    this.onReady = onReady;
    this.kept = new Map();
    this.most = Math.max(4, Math.floor(64 / Math.max(cameras.length, 1)));
  }

  /* The pictures of a frame, null for a camera that has none; or null altogether while they are decoded. */
  of(frame) {
    const found = this.kept.get(frame);
    if (found === undefined) this.load(frame);
    return found || null;
  }

  load(frame) {
    if (this.kept.has(frame)) return;
    this.kept.set(frame, null);
    Promise.all(take.pictures[frame].map(decoded)).then((bitmaps) => {
      this.kept.set(frame, bitmaps);
      this.forget(frame);
      this.onReady();
    });
  }

  forget(except) {
    for (const [frame, bitmaps] of this.kept) {
      if (this.kept.size <= this.most) return;
      if (bitmaps === null || frame === except) continue;
      this.kept.delete(frame);
      for (const bitmap of bitmaps) if (bitmap) bitmap.close();
    }
  }
}

async function decoded(jpeg) {
  return jpeg === null ? null : createImageBitmap(new Blob([bytesOf(jpeg)], { type: "image/jpeg" }));
}
