// Find and make elements of the page, and write what they say.
export const $ = (id) => document.getElementById(id);
export const make = (tag, properties = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
};
export const coloured = (element, colour) => (element.style.setProperty("--c", `rgb(${colour.join()})`), element);
export const words = (name) => name.replaceAll("_", " ");
export const grouped = (number) => number.toLocaleString("en").replaceAll(",", "\u202f");
