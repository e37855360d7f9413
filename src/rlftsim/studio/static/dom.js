// Small helpers for the document. Text is always set as text, never as HTML.

const byId = (id) => document.getElementById(id);

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

export { byId, closeDialog, make, openDialog, speak, toast };
