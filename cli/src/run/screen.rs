//! Prints the output of a live run: permanent lines, and below them the current statistics.

use std::collections::{BTreeMap, HashSet};
use std::io::{self, Write};
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_lambda::Clip;
use gleaner_protocol::ingress::{IngressReport, IngressStatus};
use gleaner_protocol::link::{Loss, RecorderReport};
use gleaner_protocol::{LiveStatus, LiveTopic, Report};
use gleaner_supervisor::{InferenceEvent, LambdaSpec, RestartedPart, RunObserver};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::output::print_error;
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
    recorder: String,
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

    fn report(&self, report: &impl Serialize) {
        if self.json {
            self.out(&render::json_line(report));
        }
    }

    /// Prints permanent text, escaped, unless `--json` is set.
    fn print(&self, text: &str) {
        if !self.json {
            self.out(&self.paint.escaped(text));
        }
    }

    fn clip(&self, clip: &Clip) {
        self.print(&render::clip_line(clip, self.paint));
    }

    fn live(&mut self, lambda: &str, live: &LiveStatus) {
        self.warn_of_missing_writers(live);
        self.lambdas.insert(lambda.to_owned(), render::live(live, self.paint));
        // Each lambda has one each second.
        if self.lacks_ingress && self.shown.elapsed() >= STATISTICS_INTERVAL {
            self.show();
        }
    }

    /// Shows the status of the ingress, and below it the last ones of all others. The ingress has
    /// one each second.
    fn show_ingress(&mut self, status: &IngressStatus) {
        self.lacks_ingress = false;
        self.ingress = render::ingress(status, self.paint);
        self.show();
    }

    fn show(&mut self) {
        if !self.stats {
            return;
        }
        self.shown = Instant::now();
        let lambdas: String = self.lambdas.values().map(String::as_str).collect();
        let text = self.paint.escaped(&format!("{}{lambdas}{}", self.ingress, self.recorder));
        if self.below.is_hidden() {
            self.out(&text);
        } else {
            self.below.set_message(text.trim_end().to_owned());
            self.below.tick();
        }
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

    fn ended(&mut self, lambda: &str, live: &LiveStatus) {
        self.lambdas.remove(lambda);
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

    fn out(&self, text: &str) {
        // A closed pipe is not an error, since the results are in files.
        self.below.suspend(|| {
            drop(io::stdout().write_all(text.as_bytes()).and_then(|()| io::stdout().flush()))
        });
    }
}

impl RunObserver for Screen {
    fn lambda(&mut self, lambda: &LambdaSpec, report: &Report) {
        let (name, prefix) = (lambda.name(), &*lambda.prefix);
        if self.json {
            self.out(&render::json_line(&render::named_report(name, report)));
        }
        match report {
            Report::Isolation { layers } => {
                self.print(&format!("{prefix}{}", render::isolation(layers)));
            }
            Report::Ready => {
                // Of several lambdas, each has its name before its lines.
                let how_to_end = if prefix.is_empty() { "; Ctrl-C ends it" } else { "" };
                self.print(&format!("{prefix}running{how_to_end}\n"));
            }
            Report::Decision(decision) => {
                self.print(&render::decision(decision, prefix, self.paint));
            }
            Report::Live(live) => self.live(name, live),
            Report::Ended(live) => self.ended(name, live),
            _ => {}
        }
    }

    fn lambda_gone(&mut self, lambda: &LambdaSpec) {
        self.lambdas.remove(lambda.name());
    }

    fn ingress(&mut self, report: &IngressReport) {
        self.report(report);
        if let IngressReport::Status(status) = report {
            self.show_ingress(status);
        }
    }

    fn ingress_gone(&mut self) {
        self.lacks_ingress = true;
        self.ingress = format!("{}: has ended, and is started again\n", self.paint.bold("ingress"));
        self.show();
    }

    fn ingress_ended(&mut self, status: &IngressStatus) {
        self.clear();
        self.print(&render::ingress(status, self.paint));
    }

    fn recorder(&mut self, report: &RecorderReport) {
        self.report(report);
        match report {
            RecorderReport::Clip(clip) => self.clip(clip),
            RecorderReport::Recovered(clip) => {
                self.warn("recovered a clip of an earlier recorder that crashed");
                self.clip(clip);
            }
            RecorderReport::Loss(loss) => self.warn(&match loss {
                Loss::Deleted { file, reason, .. } => {
                    format!("deleted the clip `{}`: {reason}", file.display())
                }
                Loss::NotDeleted { file, reason, .. } => {
                    format!("cannot delete the clip `{}`: {reason}", file.display())
                }
                Loss::Failed { reason, .. } => format!("cannot write a clip: {reason}"),
                Loss::DiskSuppressed { triggers, reason, .. } => {
                    format!("{triggers} triggers without a window: {reason}")
                }
            }),
            RecorderReport::Status(status) => self.recorder = render::recorder(status, self.paint),
            RecorderReport::Ended(status) => {
                self.recorder.clear();
                self.print(&render::recorder(status, self.paint));
            }
            RecorderReport::Ready => {}
        }
    }

    fn inference(&mut self, event: InferenceEvent) {
        let InferenceEvent::Report(report) = &event else {
            return self.stderr(render::inference_event(&event, self.paint).as_bytes());
        };
        self.report(report);
        self.print(&render::inference(report, self.paint));
    }

    fn playing(&mut self, files: &str) {
        self.print(&format!("playing {files}\n"));
    }

    fn restarts(&mut self, _: RestartedPart<'_>, reason: &str, delay: Duration, restarts: u32) {
        let delay = delay.as_secs_f64();
        self.warn(&format!("{reason}; restarting in {delay} s (restart {restarts})"));
    }

    fn warn(&mut self, text: &str) {
        self.stderr(format!("warning: {}\n", visible(text)).as_bytes());
    }

    fn stderr(&mut self, piece: &[u8]) {
        self.below.suspend(|| print_error(&String::from_utf8_lossy(piece)));
    }
}
