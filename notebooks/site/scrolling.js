// What scrolls sideways is reached by the keyboard, too.
const focus = () => document.querySelectorAll("pre, pre > code, .md-typeset__scrollwrap, .highlight-ipynb").forEach(box => {
  if (box.scrollWidth > box.clientWidth) box.tabIndex = 0;
});
addEventListener("load", focus);
addEventListener("resize", focus);
