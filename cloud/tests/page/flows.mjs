// Uses the page of the cloud in Chromium as people do. `cargo xtask page` starts it with the paths
// of the modules, of the cloud with its vehicles, of the browser, and of a folder for screenshots.

import assert from "node:assert/strict";
import { spawn } from "node:child_process";
import { mkdirSync } from "node:fs";
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { createInterface } from "node:readline";

const [modules, fleetProgram, browserProgram, shots] = process.argv.slice(2);
const require = createRequire(`${modules}/flows.js`);
const { chromium } = require("playwright-core");
const axe = require.resolve("axe-core/axe.min.js");

const PASSWORD = "correct horse battery staple";
const FIRST_LOAD_MAX = 200_000;
const PAGES = {
  fleet: "/vehicles",
  vehicle: "/vehicles/car-1",
  hostile: "/vehicles/truck-1",
  "time-line": "/vehicles/truck-1/events",
  records: "/vehicles/truck-1/lambdas/brake-dark",
  clips: "/clips",
  clip: "/clips/brake-dark-0%40car-1",
  "hostile-clip": "/clips/brake-dark-0%40truck-1",
  deployments: "/deployments",
  deployment: "/deployments/hard-brake",
  lambdas: "/lambdas",
  access: "/access",
  audit: "/audit",
  account: "/account",
};

mkdirSync(shots, { recursive: true });
const fleet = spawn(fleetProgram, [], { stdio: ["pipe", "pipe", "inherit"] });
const lines = createInterface({ input: fleet.stdout });
const { address, code } = JSON.parse(await new Promise((first) => lines.once("line", first)));
const browser = await chromium.launch({
  executablePath: browserProgram,
  args: ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync"],
});

// Errors of scripts, and what the content security policy has refused.
const complaints = [];

async function open(options = {}) {
  const context = await browser.newContext({ baseURL: address, ...options });
  context.setDefaultTimeout(20_000);
  const page = await context.newPage();
  page.on("pageerror", (error) => complaints.push(String(error)));
  page.on("dialog", (dialog) => complaints.push(`a dialog: ${dialog.message()}`));
  page.on("console", (message) => {
    const text = message.text();
    // Requests that are refused, and connections that end, are part of the flows.
    const isExpected = text.startsWith("Failed to load resource") || text === "[object Event]";
    if (message.type() === "error" && !isExpected)
      complaints.push(text);
  });
  return page;
}

async function enterCode(page, oneTime) {
  await page.goto("/login");
  await page.getByLabel("One-time code").fill(oneTime);
  await page.getByRole("region", { name: "By code" }).getByRole("button").click();
  await page.waitForURL("**/account?done=first");
}

async function enterPassword(page, name) {
  await page.goto("/login");
  await page.getByLabel("Name", { exact: true }).fill(name);
  await page.getByLabel("Password", { exact: true }).fill(PASSWORD);
  await page.getByRole("region", { name: "By password" }).getByRole("button").click();
  await page.waitForURL("**/vehicles");
}

const names = (page) => page.locator("tbody th a").allTextContents();
const has = (page, text) => page.getByText(text).first().waitFor();
const button = (page, name) => page.getByRole("button", { name, exact: true });

async function confirm(page, within, name) {
  await within.locator("summary", { hasText: name }).click();
  await within.getByRole("button", { name, exact: true }).click();
}

const admin = await open();
let guest;

const flows = {
  async "the first load is small, and needs nothing from elsewhere"() {
    const page = await open();
    const loads = [];
    page.on("requestfinished", (request) => loads.push(request));
    await page.goto("/login", { waitUntil: "networkidle" });
    let bytes = 0;
    for (const request of loads) {
      assert.ok(request.url().startsWith(address), request.url());
      const sizes = await request.sizes();
      bytes += sizes.responseBodySize + sizes.responseHeadersSize;
    }
    console.log(`  first load: ${bytes} bytes in ${loads.length} requests`);
    assert.ok(bytes <= FIRST_LOAD_MAX, `${bytes} bytes`);
    await page.context().close();
  },
  async "login by code"() {
    await admin.goto("/");
    await admin.waitForURL("**/login");
    await admin.getByLabel("One-time code").fill("glc_wrong");
    await admin.getByRole("region", { name: "By code" }).getByRole("button").click();
    await has(admin, "the code is not valid");
    await enterCode(admin, code);
    assert.ok(!admin.url().includes(code));
  },
  async "a password, and login by it"() {
    await admin.getByLabel("New password", { exact: true }).fill(PASSWORD);
    await admin.getByLabel("New password again").fill(PASSWORD);
    await button(admin, "Set a password").click();
    await has(admin, "The password is set");
    await button(admin, "Log out").click();
    await enterPassword(admin, "ann");
  },
  async "the fleet, with filters and by the keyboard"() {
    await admin.goto("/vehicles");
    assert.deepEqual(await names(admin), ["car-1", "car-2", "car-3", "truck-1"]);
    await admin.keyboard.press("Tab");
    await admin.keyboard.press("Enter");
    assert.equal(await admin.evaluate(() => document.activeElement.id), "content");
    await admin.keyboard.press("Tab");
    await admin.keyboard.type("car");
    await admin.getByLabel("Label", { exact: true }).fill("site=berlin");
    await admin.keyboard.press("Enter");
    await admin.waitForURL(/label=site/);
    assert.deepEqual(await names(admin), ["car-1", "car-2"]);
    await admin.goto("/vehicles");
    await admin.getByLabel("State", { exact: true }).selectOption("invited");
    await button(admin, "Show").click();
    await admin.waitForURL(/state=invited/);
    assert.deepEqual(await names(admin), ["car-3"]);
    await admin.getByRole("link", { name: "1 vehicle with problems" }).click();
    await admin.waitForURL(/problem=yes/);
    assert.deepEqual(await names(admin), ["truck-1"]);
  },
  async "a vehicle; what it sends is no markup"() {
    await admin.goto("/vehicles/car-1");
    for (const text of ["73,012", "Sample to wake", "Sandbox (checked at start)", "landlock", "/vehicle/imu"])
      await has(admin, text);
    await admin.goto("/vehicles/truck-1");
    await has(admin, "<script>document.title='x'</script>");
    assert.equal(await admin.title(), "truck-1 – Gleaner");
    assert.equal(await admin.locator("main img").count(), 0);
    // The part that is refreshed shows the same.
    await admin.waitForResponse((reply) => reply.request().headers()["hx-request"] === "true");
    await has(admin, "<script>document.title='x'</script>");
  },
  async "a vehicle is enrolled by a file, and cut off"() {
    await admin.goto("/access");
    const form = admin.getByRole("region", { name: "Enrol a vehicle" });
    await form.getByLabel("Name", { exact: true }).fill("car-9");
    const [download] = await Promise.all([
      admin.waitForEvent("download"), form.getByRole("button").click(),
    ]);
    assert.equal(download.suggestedFilename(), "car-9.json");
    const enrolment = JSON.parse(await readFile(await download.path(), "utf8"));
    assert.equal(enrolment.gleaner_enrolment, 1);
    await admin.reload();
    const row = admin.getByRole("listitem").filter({ hasText: "car-9" });
    await confirm(admin, row, "Revoke");
    await has(admin, "The vehicle is revoked.");
  },
  async "records follow live, and go on after a lost connection"() {
    await admin.goto("/vehicles/car-1/lambdas/brake-dark");
    await has(admin, "Following: new records appear at the top.");
    const times = () => admin.locator(".line time").allTextContents();
    const grow = async () => {
      const before = (await times()).length;
      await admin.waitForFunction(
        (count) => document.querySelectorAll(".line").length > count + 1, before);
    };
    await grow();
    await admin.context().setOffline(true);
    await admin.waitForTimeout(1500);
    await admin.context().setOffline(false);
    await grow();
    const shown = await times();
    assert.equal(new Set(shown).size, shown.length, "none twice");
    assert.deepEqual(shown, shown.toSorted().toReversed(), "the newest first");
    await admin.goto("/vehicles/car-1/events");
    await has(admin, "speed_ms=13.9");
    assert.equal(await admin.getByText("brightness").count(), 0, "no log lines");
  },
  async "a clip is found in the time line, fetched, and looked into"() {
    await admin.goto("/vehicles/car-1/events");
    const card = admin.getByRole("link", { name: /hard-brake/ });
    const width = (image) => image.naturalWidth;
    await admin.waitForFunction(() => document.querySelector(".clip img")?.naturalWidth > 0);
    await card.click();
    await admin.waitForURL("**/clips/brake-dark-0%40car-1");
    for (const text of ["0.912", "speed_ms=13.9", "12.0 s", "on the vehicle"])
      await has(admin, text);
    assert.ok(await admin.locator(".thumbnail img").evaluate(width) > 0);
    await button(admin, "Fetch from the vehicle").click();
    // Refreshed without a reload, once the vehicle has sent it.
    const link = admin.getByRole("link", { name: "Download" });
    const [download] = await Promise.all([admin.waitForEvent("download"), link.click()]);
    assert.equal(download.suggestedFilename(), "brake-dark-0.mcap");
    const magic = (await readFile(await download.path())).subarray(1, 5).toString();
    assert.equal(magic, "MCAP");
    await admin.reload();
    await admin.getByRole("row", { name: /\/vehicle\/imu sensor_msgs\/msg\/Imu 1,200 100/ }).waitFor();
  },
  async "clips of the fleet are filtered; one that is hostile is no markup, and no image"() {
    await admin.goto("/clips");
    assert.equal(await admin.locator(".clip").count(), 4);
    await admin.getByLabel("Label", { exact: true }).fill("dark");
    await button(admin, "Show").click();
    await admin.waitForURL(/label=dark/);
    assert.equal(await admin.locator(".clip").count(), 1);
    await admin.goto("/clips/brake-dark-0%40truck-1");
    await has(admin, "<script>document.title='x'</script>");
    assert.match(await admin.title(), /of truck-1 – Gleaner$/);
    assert.equal(await admin.locator("main img").count(), 0);
    await has(admin, "no image");
  },
  async "a deployment is stopped, started, rolled back and removed"() {
    await admin.goto("/deployments");
    await admin.getByRole("link", { name: "hard-brake" }).click();
    const changes = admin.getByRole("region", { name: "Change" });
    await confirm(admin, changes, "Stop");
    await has(admin, "Stopping on its vehicles");
    // Refreshed without a reload.
    await admin.locator("figcaption", { hasText: /0\s*running/ }).waitFor();
    await button(admin, "Start").click();
    await has(admin, "Starting on its vehicles");
    await admin.locator("figcaption", { hasText: /2\s*running/ }).waitFor();
    await confirm(admin, changes, "Roll back");
    await has(admin, "Rolling back its vehicles");
    await admin.goto("/lambdas");
    await admin.getByRole("row", { name: /hard-brake/ }).first().getByRole("link").first().click();
    await has(admin, "lambda.toml");
  },
  async "a user is invited, and denied what the role has not"() {
    await admin.goto("/access");
    const form = admin.getByRole("region", { name: "Invite a user" });
    await form.getByLabel("Name", { exact: true }).fill("vic");
    await form.getByRole("button").click();
    const oneTime = await admin.locator("#invitation").textContent();
    guest = await open();
    await enterCode(guest, oneTime);
    assert.equal(await guest.getByRole("link", { name: "Access" }).count(), 0);
    assert.equal((await guest.goto("/access")).status(), 403);
    await has(guest, "this needs admin");
    await guest.goto("/deployments/hard-brake");
    assert.equal(await guest.locator("summary", { hasText: "Stop" }).count(), 0);
    await guest.goto("/clips/brake-dark-60000000000%40car-1");
    await has(guest, "Operators can fetch it");
    assert.equal(await button(guest, "Fetch from the vehicle").count(), 0);
  },
  async "the audit trail has each change"() {
    await admin.goto("/audit");
    const changes = await admin.locator("tbody tr td:nth-child(4)").allTextContents();
    for (const change of ["invite as viewer", "roll back", "stop", "start", "set password"])
      assert.ok(changes.includes(change), change);
  },
  async "a removed user is logged out at once"() {
    await guest.goto("/vehicles/car-1/lambdas/brake-dark");
    await has(guest, "Following: new records appear at the top.");
    await admin.goto("/access");
    const row = admin.getByRole("listitem").filter({ hasText: "vic" });
    await confirm(admin, row, "Remove");
    await has(admin, "The user is removed");
    await has(guest, "Connection lost");
    await guest.goto("/vehicles");
    await guest.waitForURL("**/login");
  },
  async "each page is accessible, light and dark, wide and narrow"() {
    for (const [scheme, width] of [["light", 1280], ["dark", 1280], ["light", 390]]) {
      await admin.emulateMedia({ colorScheme: scheme });
      await admin.setViewportSize({ width, height: 900 });
      for (const [name, path] of Object.entries(PAGES)) {
        await admin.goto(path);
        // A narrow window changes sizes only.
        if (width > 1000) await check(admin, `${name} ${scheme}`);
        const wider = () => document.documentElement.scrollWidth - window.innerWidth;
        assert.ok((await admin.evaluate(wider)) <= 0, `${name} is wider than ${width}`);
        await admin.screenshot({ path: `${shots}/${name}-${scheme}-${width}.png`, fullPage: true });
      }
    }
    await admin.emulateMedia({ colorScheme: "light" });
    await admin.setViewportSize({ width: 1280, height: 900 });
  },
  async "all of it works without scripts"() {
    const page = await open({ javaScriptEnabled: false });
    await enterPassword(page, "ann");
    await page.getByLabel("Label", { exact: true }).fill("site=ulm");
    await button(page, "Show").click();
    await page.waitForURL(/label=site/);
    assert.deepEqual(await names(page), ["truck-1"]);
    await page.goto("/vehicles/car-1/lambdas/brake-dark");
    await has(page, "brightness");
    assert.match(await page.content(), /Without scripts, load the page again/);
    await page.goto("/clips/brake-dark-60000000000%40car-1");
    await button(page, "Fetch from the vehicle").click();
    await has(page, "The file is wanted");
    await page.goto("/deployments/brake-dark");
    const changes = page.getByRole("region", { name: "Change" });
    await confirm(page, changes, "Stop");
    await has(page, "Stopping on its vehicles");
    await confirm(page, changes, "Remove");
    await has(page, "The deployment is removed.");
    await button(page, "Log out").click();
    await page.waitForURL("**/login");
    await page.context().close();
  },
  async "logout"() {
    const context = admin.context();
    const [session] = await context.cookies();
    assert.ok(session.httpOnly && session.sameSite === "Strict");
    await admin.goto("/vehicles");
    await button(admin, "Log out").click();
    await admin.waitForURL("**/login");
    await check(admin, "login");
    await admin.screenshot({ path: `${shots}/login.png`, fullPage: true });
    await context.addCookies([session]);
    await admin.goto("/vehicles");
    await admin.waitForURL("**/login");
  },
};

// Fails on what axe reports as serious.
async function check(page, name) {
  // The policy of the page refuses other scripts; one that is evaluated is not refused.
  await page.evaluate(await readFile(axe, "utf8"));
  const { violations } = await page.evaluate(() => axe.run());
  const serious = violations.filter(({ impact }) => impact === "serious" || impact === "critical");
  const places = serious.map(({ id, nodes }) => `${id}: ${nodes.map((it) => it.html).join(" ")}`);
  assert.deepEqual(places, [], name);
}

let failed = 0;
const begin = Date.now();
for (const [name, flow] of Object.entries(flows)) {
  const start = Date.now();
  try {
    await flow();
    assert.deepEqual(complaints.splice(0), []);
    console.log(`ok      ${name} (${Date.now() - start} ms)`);
  } catch (error) {
    failed += 1;
    console.log(`FAILED  ${name}\n${error.stack}`);
    await admin.screenshot({ path: `${shots}/failed-${failed}.png` }).catch(() => {});
  }
}
await browser.close();
fleet.stdin.end();
const passed = Object.keys(flows).length - failed;
console.log(`${passed} flows passed, ${failed} failed, in ${Math.round((Date.now() - begin) / 1000)} s`);
process.exitCode = failed === 0 ? 0 : 1;
