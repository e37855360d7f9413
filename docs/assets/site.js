// Films, the pictures whose text begins so, stand still where the system asks for less motion; a press plays them.
if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
  for (const film of document.querySelectorAll('img[alt^="Film"]')) {
    const hold = () => {
      const canvas = document.createElement("canvas"), button = document.createElement("button");
      canvas.width = film.naturalWidth; canvas.height = film.naturalHeight;
      canvas.getContext("2d").drawImage(film, 0, 0); // always the first frame
      button.className = "still"; button.setAttribute("aria-label", `Play: ${film.alt}`);
      button.append(canvas);
      button.addEventListener("click", () => button.replaceWith(film));
      film.replaceWith(button);
    };
    if (film.complete) hold(); else film.addEventListener("load", hold, { once: true });
  }
}

// Wide tables, which the theme wraps when the page is there, scroll by keyboard, too.
const reach = () => { for (const wide of document.querySelectorAll(".md-typeset__scrollwrap")) wide.tabIndex = 0; };
new MutationObserver(reach).observe(document.body, { childList: true, subtree: true });
reach();
