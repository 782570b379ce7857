//! Prints the output of a live run: permanent lines, and below them the current statistics.

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Write};
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_lambda::{Clip, Decision};
use gleaner_protocol::ingress::IngressStatus;
use gleaner_protocol::link::RecorderStatus;
use gleaner_protocol::{LiveStatus, LiveTopic, Report};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::inference::InferenceEvent;
use crate::render::{self, Paint};

/// Time without a writer after which a warning about a topic is printed, in s.
const WAITING_S: f64 = 3.0;

/// Time after which the statistics are shown again while there is no ingress: a bit less than the
/// second after which a lambda has its next status.
const STATISTICS_INTERVAL: Duration = Duration::from_millis(900);

/// Standard output, and on a terminal the statistics below it.
pub(super) struct Screen {
    stats: bool,
    json: bool,
    paint: Paint,
    /// Topics without a writer for which a warning was printed.
    warned: HashSet<String>,
    /// Last status of each running lambda, formatted, by its name.
    lambdas: BTreeMap<String, String>,
    /// Last status of the recorder, formatted.
    recorder: String,
    /// Last status of the ingress, formatted.
    ingress: String,
    /// Set while there is no ingress, whose status shows the statistics otherwise.
    lacks_ingress: bool,
    shown: Instant,
    /// The statistics; indicatif hides them if standard error is not a terminal.
    below: ProgressBar,
}

impl Screen {
    pub(super) fn new(stats: bool, json: bool) -> Self {
        let target =
            if stats { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
        let below = ProgressBar::with_draw_target(None, target);
        let style =
            ProgressStyle::with_template("{msg}").unwrap_or_else(|_| ProgressStyle::default_bar());
        Self {
            stats,
            json,
            paint: Paint::of_stdout(),
            warned: HashSet::new(),
            lambdas: BTreeMap::new(),
            recorder: String::new(),
            ingress: String::new(),
            lacks_ingress: false,
            shown: Instant::now(),
            below: below.with_style(style),
        }
    }

    /// Prints a report with `--json`.
    pub(super) fn report(&self, report: &impl Serialize) {
        if self.json {
            self.out(&render::json_line(report));
        }
    }

    /// Prints a report of a lambda's process with `--json`.
    pub(super) fn lambda_report(&self, lambda: &str, report: &Report) {
        if self.json {
            self.out(&render::json_line(&render::named_report(lambda, report)));
        }
    }

    /// Prints permanent text, unless `--json` is set.
    pub(super) fn print(&self, text: &str) {
        if !self.json {
            self.out(text);
        }
    }

    /// Reports that a lambda is ready. `prefix` is its name before each line, if there are several.
    pub(super) fn ready(&self, prefix: &str) {
        let how_to_end = if prefix.is_empty() { "; Ctrl-C ends it" } else { "" };
        self.print(&format!("{prefix}running{how_to_end}\n"));
    }

    pub(super) fn decision(&self, prefix: &str, decision: &Decision) {
        self.print(&render::decision(decision, prefix, self.paint));
    }

    pub(super) fn clip(&self, clip: &Clip) {
        self.print(&render::clip_line(clip, self.paint));
    }

    /// Updates the status of the recorder, which is shown below those of the lambdas.
    pub(super) fn recorder(&mut self, status: &RecorderStatus) {
        self.recorder = render::recorder(status, self.paint);
    }

    /// Prints the final status of the recorder.
    pub(super) fn recorder_ended(&mut self, status: &RecorderStatus) {
        self.recorder.clear();
        self.print(&render::recorder(status, self.paint));
    }

    /// Shows an event of the process that runs models.
    pub(super) fn inference(&mut self, event: &InferenceEvent) {
        let InferenceEvent::Report(report) = &event else {
            return self.err(&event.text(self.paint));
        };
        self.report(report);
        self.print(&render::inference(report, self.paint));
    }

    /// Updates the status of a lambda.
    pub(super) fn live(&mut self, lambda: &str, live: &LiveStatus) {
        self.warn_of_missing_writers(live);
        self.lambdas.insert(lambda.to_owned(), render::live(live, self.paint));
        // Each lambda has one each second.
        if self.lacks_ingress && self.shown.elapsed() >= STATISTICS_INTERVAL {
            self.show();
        }
    }

    /// Removes the status of a lambda whose process has ended.
    pub(super) fn gone(&mut self, lambda: &str) {
        self.lambdas.remove(lambda);
    }

    /// Shows the status of the ingress, and below it the last ones of all others. The ingress has
    /// one each second.
    pub(super) fn ingress(&mut self, status: &IngressStatus) {
        self.lacks_ingress = false;
        self.ingress = render::ingress(status, self.paint);
        self.show();
    }

    /// Shows that there is no ingress, until [`ingress`](Self::ingress) shows the status of the
    /// next one.
    pub(super) fn ingress_gone(&mut self) {
        self.lacks_ingress = true;
        self.ingress = format!("{}: has ended, and is started again\n", self.paint.bold("ingress"));
        self.show();
    }

    /// Shows the statistics.
    fn show(&mut self) {
        if !self.stats {
            return;
        }
        self.shown = Instant::now();
        let lambdas: String = self.lambdas.values().map(String::as_str).collect();
        let text = format!("{}{lambdas}{}", self.ingress, self.recorder);
        if self.below.is_hidden() {
            self.out(&text);
        } else {
            self.below.set_message(text.trim_end().to_owned());
            self.below.tick();
        }
    }

    /// Prints the final status of the ingress.
    pub(super) fn ingress_ended(&mut self, status: &IngressStatus) {
        self.clear();
        self.print(&render::ingress(status, self.paint));
    }

    /// Warns once about each topic without a writer.
    fn warn_of_missing_writers(&mut self, live: &LiveStatus) {
        let has_no_writer = |topic: &&LiveTopic| topic.writers == Some(0) && topic.received == 0;
        if live.up_s < WAITING_S {
            return;
        }
        for topic in live.topics.iter().filter(has_no_writer) {
            if self.warned.insert(topic.topic.clone()) {
                let name = visible(&topic.topic);
                let kind = visible(&topic.type_name);
                self.warn(&format!(
                    "no writer of `{name}` ({kind}) yet; `gleaner topics` lists the topics"
                ));
            }
        }
    }

    /// Prints the final status of a lambda.
    pub(super) fn ended(&mut self, lambda: &str, live: &LiveStatus) {
        self.gone(lambda);
        self.clear();
        self.print(&render::live(live, self.paint));
        self.print(&format!(
            "  {}: decisions.jsonl, log.jsonl, summary.json\n",
            visible(&live.out.to_string_lossy())
        ));
    }

    /// Clears the statistics. The next status of the ingress shows them again.
    fn clear(&self) {
        self.below.set_message("");
        self.below.tick();
    }

    /// Warns that something failed for a reason, and is started again after a delay.
    pub(super) fn restarts(&self, reason: &str, delay: Duration, restarts: u32) {
        let delay = delay.as_secs_f64();
        self.warn(&format!("{reason}; restarting in {delay} s (restart {restarts})"));
    }

    pub(super) fn warn(&self, text: &str) {
        self.err(format!("warning: {}\n", visible(text)).as_bytes());
    }

    /// Prints a piece of a program's standard error.
    pub(super) fn err(&self, piece: &[u8]) {
        // An error of standard error itself cannot be reported.
        self.below.suspend(|| drop(io::stderr().write_all(piece)));
    }

    fn out(&self, text: &str) {
        // A closed pipe is not an error, since the results are in files.
        self.below.suspend(|| {
            drop(io::stdout().write_all(text.as_bytes()).and_then(|()| io::stdout().flush()))
        });
    }
}
