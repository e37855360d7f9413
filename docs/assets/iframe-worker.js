/* Search in pages that are opened from disk. A browser starts no worker for file: addresses, so the worker's script
   runs in a hidden frame, which has what such a script uses: postMessage, onmessage and importScripts. */
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      document.body.append(this.frame);
      const scope = this.frame.contentWindow;
      const load = (source) =>
        new Promise((resolve, reject) => {
          const script = scope.document.createElement("script");
          Object.assign(script, { src: new URL(source, location.href).href, onload: resolve, onerror: reject });
          scope.document.body.append(script);
        });
      scope.importScripts = (...sources) => sources.reduce((all, one) => all.then(() => load(one)), Promise.resolve());
      scope.postMessage = (data) => {
        const event = new MessageEvent("message", { data });
        this.dispatchEvent(event);
        this.onmessage?.(event);
      };
      this.ready = load(url);
    }
    postMessage(data) {
      // In order, not before the script listens, and a copy, as a worker gets.
      this.ready = this.ready.then(() => {
        const { MessageEvent } = this.frame.contentWindow;
        this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data: structuredClone(data) }));
      });
    }
    terminate() {
      this.frame.remove();
    }
  };
}
