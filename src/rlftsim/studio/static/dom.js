// Small helpers for the document. Text is always set as text, never as HTML.

/** An element of index.html, where each id is of the kind that its use needs. @returns {any} */
const byId = (id) => document.getElementById(id);

/** The picture of a canvas. `onCpu` keeps it in the CPU's memory, as a context without a GPU is emulated. @returns {CanvasRenderingContext2D} */
const contextOf = (canvas, { onCpu = false, alpha = true } = {}) => canvas.getContext("2d", { willReadFrequently: onCpu, alpha });

/** Pixels of the screen for one of a canvas' own, in zoomed parts of the page too. */
const pixelRatio = (canvas) => (devicePixelRatio || 1) * (canvas.currentCSSZoom || 1);

/** An element with properties (`class`, `onclick`, attributes) and children, which are elements or text. */
function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name === "class") element.className = value;
    else if (name === "width") element.style.width = value; // the policy of the page allows styles from scripts only
    else element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

const speak = (text) => { byId("speaker").textContent = text; };

let hiding = 0;
function toast(text) {
  byId("toast").textContent = text; byId("toast").hidden = false;
  clearTimeout(hiding);
  hiding = setTimeout(() => { byId("toast").hidden = true; }, 6000);
}

/** Opens the dialog with a title and some content; Escape and the button close it. */
function openDialog(title, ...content) {
  byId("dialog-body").replaceChildren(make("h2", { id: "dialog-title" }, title), ...content, make("p", {}, make("button", { value: "close" }, "close")));
  byId("dialog").setAttribute("aria-labelledby", "dialog-title");
  if (!byId("dialog").open) byId("dialog").showModal();
}

const closeDialog = () => byId("dialog").close();

export { byId, closeDialog, contextOf, make, openDialog, pixelRatio, speak, toast };
