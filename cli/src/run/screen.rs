//! What is shown while a lambda runs: lines that stay, and below them how it is doing.

use std::collections::HashSet;
use std::io::{self, Write};

use gleaner_base::visible;
use gleaner_lambda::{Clip, Decision};
use gleaner_protocol::link::RecorderStatus;
use gleaner_protocol::{Live, LiveTopic};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;

use crate::show::{self, Paint};

/// How long a topic may be without a writer before somebody is told.
const WAITING_S: f64 = 3.0;

/// Standard output, and on a terminal the lines below it.
pub(super) struct Screen {
    stats: bool,
    json: bool,
    paint: Paint,
    /// Topics of which it was said that nobody writes them.
    waited: HashSet<String>,
    /// What was said last of the recorder.
    recorder: String,
    /// Hidden by itself where standard error is no terminal.
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
            waited: HashSet::new(),
            recorder: String::new(),
            below: below.with_style(style),
        }
    }

    /// A report as it came, where reports are wanted.
    pub(super) fn report(&self, report: &impl Serialize) {
        if self.json {
            self.out(&show::json_line(report));
        }
    }

    /// Something that stays, for people.
    pub(super) fn say(&self, text: &str) {
        if !self.json {
            self.out(text);
        }
    }

    pub(super) fn decision(&self, decision: &Decision) {
        self.say(&show::decision(decision, self.paint));
    }

    pub(super) fn clip(&self, clip: &Clip) {
        self.say(&show::clip_line(clip, self.paint));
    }

    /// How the recorder is doing: below what is said of the lambda.
    pub(super) fn recorder(&mut self, status: &RecorderStatus) {
        self.recorder = show::recorder(status, self.paint);
    }

    /// How the recorder was.
    pub(super) fn recorder_ended(&mut self, status: &RecorderStatus) {
        self.say(&show::recorder(status, self.paint));
    }

    /// How it is doing.
    pub(super) fn live(&mut self, live: &Live) {
        self.say_who_waits(live);
        if !self.stats {
            return;
        }
        let text = show::live(live, self.paint) + &self.recorder;
        if self.below.is_hidden() {
            self.out(&text);
        } else {
            self.below.set_message(text.trim_end().to_owned());
            self.below.tick();
        }
    }

    /// Says once for each topic that nobody writes it.
    fn say_who_waits(&mut self, live: &Live) {
        let is_alone = |topic: &&LiveTopic| topic.writers == Some(0) && topic.received == 0;
        if live.up_s < WAITING_S {
            return;
        }
        for topic in live.topics.iter().filter(is_alone) {
            if self.waited.insert(topic.topic.clone()) {
                let name = visible(&topic.topic);
                let kind = visible(&topic.type_name);
                self.warn(&format!(
                    "nobody writes `{name}` ({kind}) yet; `gleaner topics` shows what is there"
                ));
            }
        }
    }

    /// How it was.
    pub(super) fn ended(&self, live: &Live) {
        // It may start again, and then has lines below again.
        self.below.set_message("");
        self.below.tick();
        self.say(&show::live(live, self.paint));
        self.say(&format!(
            "  {}: decisions.jsonl, log.jsonl, summary.json\n",
            visible(&live.out.to_string_lossy())
        ));
    }

    pub(super) fn warn(&self, text: &str) {
        self.err(format!("warning: {}\n", visible(text)).as_bytes());
    }

    /// Passes on what a program said.
    pub(super) fn err(&self, piece: &[u8]) {
        // Nobody is left to tell if standard error is gone.
        self.below.suspend(|| drop(io::stderr().write_all(piece)));
    }

    fn out(&self, text: &str) {
        // A reader that is gone is no failure: the results are in files.
        self.below.suspend(|| {
            drop(io::stdout().write_all(text.as_bytes()).and_then(|()| io::stdout().flush()))
        });
    }
}
