//! A lambda in the fake host: messages are delivered to it, and what it decides is kept.

use std::sync::Arc;

use gleaner_rules::faults::Faults;
use gleaner_rules::names::{COMPRESSED_IMAGE, IMAGE};
use gleaner_rules::text::quoted;

use super::data::{Source, Tick};
use super::decision::{Cause, Decision, Fault, Trigger};
use super::error::Error;
use super::log::Line;
use super::message::{ENCAPSULATION, Message};
use super::path::known;
use super::ring::{Arrival, Cell};
use super::schedule::Schedule;
use super::session::{Session, attempt};
use super::types::{Counts, Encoding, Guid, Value};
use crate::data::Sample;
use crate::{Config, Lambda};

/// A lambda that was loaded, and all that came of it so far.
///
/// Time is what the test says: that of the messages, in nanoseconds.
pub struct Run<L: Lambda> {
    config: Config,
    session: Arc<Session>,
    schedule: Schedule,
    /// None after a fault, until the next wake.
    lambda: Option<L>,
    now_ns: Option<i64>,
    decisions: Vec<Decision>,
    faults: Faults,
}

/// Why the lambda runs.
enum Due {
    Event(Arc<Source>, Arc<Cell>),
    Tick(Tick),
}

impl<L: Lambda> Run<L> {
    pub(super) fn start(
        name: &str,
        config: Config,
        session: Arc<Session>,
        schedule: Schedule,
    ) -> Result<Self, Error> {
        let (lambda, now_ns, decisions, faults) = (None, None, Vec::new(), Faults::default());
        let mut run = Self { config, session, schedule, lambda, now_ns, decisions, faults };
        match run.init() {
            Ok(()) => Ok(run),
            Err(fault) => {
                Err(Error::new(format!("cannot start lambda `{name}`"), fault.message, ""))
            }
        }
    }

    /// Delivers a message to an input at `at_ns`, and runs the lambda as its schedule says: first
    /// the ticks that were due before, then once for the message, if it wakes the lambda. Returns
    /// what was decided in these wakes.
    ///
    /// # Errors
    ///
    /// If there is no such input, time would go back, or the message cannot be one of this input.
    /// Nothing has happened then. A fault of the lambda is no error: it stands in its decision.
    pub fn deliver(
        &mut self,
        input: &str,
        at_ns: i64,
        message: Message,
    ) -> Result<&[Decision], Error> {
        let found = self.session.inputs.iter().position(|source| source.declared.name == input);
        let Some(number) = found else {
            let names =
                quoted(self.session.inputs.iter().map(|source| source.declared.name.as_str()));
            return Err(Error::new(
                format!("no input `{input}` to deliver to"),
                "",
                format!("the manifest has {names}"),
            ));
        };
        let source = Arc::clone(&self.session.inputs[number]);
        self.must_not_go_back(at_ns)?;
        let message = checked(&source, message)?;
        let before = source.lock().seq;
        let seq = message.seq.unwrap_or(before + 1);
        if seq <= before {
            let cause = format!("the message before has the number {before}");
            return Err(Error::new(
                format!("message {seq} of input `{input}` comes too late"),
                cause,
                "let numbers rise",
            ));
        }
        self.now_ns = Some(at_ns);

        let decided = self.decisions.len();
        self.ticks(at_ns);
        {
            let arrived = &mut *source.lock();
            arrived.seq = seq;
            let writer = Guid {
                high: u64::from(u32::from_be_bytes(*b"desk")) << 32,
                low: (number as u64) << 32,
            };
            let (publish_ns, bytes) =
                (message.publish_ns.unwrap_or(at_ns), message.bytes_at_least());
            arrived.ring.push(Arrival { at_ns, publish_ns, writer, seq, message }, bytes);
        }
        while let Some((source, cell)) = self.schedule.next_event() {
            self.wake(cell.sample.at_ns, Due::Event(source, cell));
        }
        Ok(&self.decisions[decided..])
    }

    /// Lets time pass up to `at_ns` without a message: ticks run that are due until then, that
    /// instant included. Returns what was decided in them. The first tick is due a period after the
    /// first message, or the first call of this.
    ///
    /// # Errors
    ///
    /// If time would go back.
    pub fn pass_to(&mut self, at_ns: i64) -> Result<&[Decision], Error> {
        self.must_not_go_back(at_ns)?;
        let decided = self.decisions.len();
        if self.now_ns.replace(at_ns).is_none() {
            self.ticks(at_ns);
        }
        self.ticks(at_ns.saturating_add(1));
        Ok(&self.decisions[decided..])
    }

    /// One decision for each wake so far.
    pub fn decisions(&self) -> &[Decision] {
        &self.decisions
    }

    /// What was triggered so far, in all wakes.
    pub fn triggers(&self) -> impl Iterator<Item = &Trigger> {
        self.decisions.iter().flat_map(|decision| &decision.triggers)
    }

    /// The faults so far. A test that expects none asks for this, or a lambda that never got
    /// further passes it.
    pub fn faults(&self) -> impl Iterator<Item = &Fault> {
        self.decisions.iter().filter_map(|decision| decision.fault.as_ref())
    }

    /// What was logged so far, and what the host noted. What a lambda prints is not in it: it is
    /// the test's own output.
    pub fn log(&self) -> Vec<Line> {
        self.session.lock().log.lines.clone()
    }

    /// What became of the samples of an input; none if there is no such input.
    pub fn counts(&self, input: &str) -> Option<Counts> {
        self.session
            .inputs
            .iter()
            .find(|source| source.declared.name == input)
            .map(|source| source.counts())
    }

    /// The lambda itself; none after a fault, until the next wake makes it anew.
    pub fn lambda(&self) -> Option<&L> {
        self.lambda.as_ref()
    }

    /// Log lines dropped by the limits of a second.
    pub fn log_dropped(&self) -> u64 {
        self.session.lock().log.dropped()
    }

    /// Triggers refused by `events_per_minute`.
    pub fn triggers_refused(&self) -> u64 {
        self.session.lock().triggers.refused()
    }

    /// Wakes passed over since the lambda had faulted again and again.
    pub fn backed_off(&self) -> u64 {
        self.session.lock().backed_off
    }

    /// Ticks that were due and did not happen.
    pub fn missed_ticks(&self) -> u64 {
        self.schedule.missed()
    }

    fn must_not_go_back(&self, at_ns: i64) -> Result<(), Error> {
        match self.now_ns {
            Some(now_ns) if at_ns < now_ns => {
                let cause = format!("it is {now_ns} ns already");
                Err(Error::new(
                    format!("time cannot go back to {at_ns} ns"),
                    cause,
                    "deliver messages in the order of time",
                ))
            }
            _ => Ok(()),
        }
    }

    fn ticks(&mut self, now_ns: i64) {
        while let Some(tick) = self.schedule.next_tick(now_ns) {
            self.wake(tick.at_ns, Due::Tick(tick));
        }
    }

    fn init(&mut self) -> Result<(), Fault> {
        let (session, config) = (Arc::clone(&self.session), &self.config);
        self.lambda = Some(session.aside(|| attempt(&session, "in init: ", || L::init(config)))?);
        Ok(())
    }

    /// From cause to decision. What a lambda triggers before it faults still counts.
    fn wake(&mut self, at_ns: i64, due: Due) {
        if self.faults.rests(at_ns) {
            self.session.lock().backed_off += 1;
            return;
        }
        let mut decision = cause(at_ns, &due);
        {
            let state = &mut *self.session.lock();
            state.now_ns = at_ns;
            state.triggers.begin();
            if let Some(note) = self.faults.begin() {
                state.log.note(at_ns, note);
            }
        }
        decision.fault = self.run(due).err();
        decision.triggers = self.session.lock().triggers.end();
        if let Some(note) = self.faults.end(at_ns, decision.fault.is_some()) {
            self.session.lock().log.note(at_ns, note);
        }
        self.decisions.push(decision);
    }

    fn run(&mut self, due: Due) -> Result<(), Fault> {
        if self.lambda.is_none() {
            self.init()?;
        }
        let session = Arc::clone(&self.session);
        let lambda = self.lambda.as_mut().expect("it was there, or has just been made");
        let ran = attempt(&session, "", || match due {
            Due::Event(source, cell) => lambda.on_event(Sample::from(source.sample(cell))),
            Due::Tick(tick) => lambda.on_tick(tick),
        });
        if ran.is_err() {
            // Its handles are given back. A component ends without dropping anything; what its
            // `drop` does is lost there, too.
            let lambda = self.lambda.take();
            let _ = session.aside(|| dropped(&session, lambda));
        }
        ran
    }
}

impl<L: Lambda> Drop for Run<L> {
    fn drop(&mut self) {
        let (session, lambda) = (Arc::clone(&self.session), self.lambda.take());
        let _ = dropped(&session, lambda);
    }
}

/// Drops a lambda where it may still call its host.
fn dropped<L>(session: &Arc<Session>, lambda: Option<L>) -> Result<(), Fault> {
    attempt(session, "", || {
        drop(lambda);
        Ok(())
    })
}

fn cause(at_ns: i64, due: &Due) -> Decision {
    let (triggers, fault) = (Vec::new(), None);
    match due {
        Due::Tick(_) => Decision {
            at_ns,
            cause: Cause::Tick,
            input: None,
            topic: None,
            seq: None,
            triggers,
            fault,
        },
        Due::Event(source, cell) => Decision {
            at_ns,
            cause: Cause::Event,
            input: Some(source.declared.name.clone()),
            topic: Some(source.declared.topic.clone()),
            seq: Some(cell.sample.seq),
            triggers,
            fault,
        },
    }
}

/// The message as it comes to an input: over its blank, and with the fields that stand for a
/// picture.
fn checked(source: &Source, mut message: Message) -> Result<Message, Error> {
    let (name, type_name) = (&source.declared.name, source.declared.type_name.as_str());
    let refuse = |cause: String, help: &str| {
        Err(Error::new(format!("cannot deliver a message to input `{name}`"), cause, help))
    };
    if message.cdr.as_ref().is_some_and(|cdr| cdr.len() < ENCAPSULATION) {
        return refuse(
            "its CDR is too short".to_owned(),
            "give it with its encapsulation, four bytes before the message",
        );
    }
    if let Some(picture) = &message.picture {
        match type_name {
            IMAGE => message.spread_picture(),
            COMPRESSED_IMAGE => {
                let needed = 3 * u64::from(picture.width) * u64::from(picture.height);
                let found = picture.data.len() as u64;
                if picture.encoding != Encoding::Rgb8 || found != needed || needed == 0 {
                    let cause = format!(
                        "{}x{} pixels of rgb8 have {needed} bytes",
                        picture.width, picture.height
                    );
                    let cause = format!(
                        "{cause}; it has {found} of {}",
                        crate::data::encoding_name(picture.encoding)
                    );
                    return refuse(
                        cause,
                        "give what the host makes of JPEG and PNG: rgb8, without padding",
                    );
                }
            }
            _ => {
                let help =
                    format!("an image goes to an input of `{IMAGE}` or `{COMPRESSED_IMAGE}`");
                return refuse(
                    format!("it is an image, and the input is of type `{type_name}`"),
                    &help,
                );
            }
        }
    }
    let Some(blank) = &source.blank else { return Ok(message) };
    for (path, value) in &mut message.fields {
        let Some(usual) = blank.fields.get(path) else {
            let cause = format!("its field `{path}` is not in the blank message of this input");
            return refuse(
                format!("{cause}{}", known(path, &blank.fields)),
                "correct the path, or add it to the blank message",
            );
        };
        if !fit(value, usual) {
            let cause =
                format!("its field `{path}` is of another sort than that of the blank message");
            return refuse(cause, "give both alike");
        }
    }
    for (path, usual) in &blank.fields {
        message.fields.entry(path.clone()).or_insert_with(|| usual.clone());
    }
    Ok(message)
}

/// Whether `value` is of the sort of `usual`; a number is made one of its sort, if it keeps its
/// value.
fn fit(value: &mut Value, usual: &Value) -> bool {
    let made = match (&*value, usual) {
        (Value::Signed(number), Value::Real(_)) => Some(Value::Real(*number as f64)),
        (Value::Unsigned(number), Value::Real(_)) => Some(Value::Real(*number as f64)),
        (Value::Signed(number), Value::Unsigned(_)) => {
            u64::try_from(*number).ok().map(Value::Unsigned)
        }
        (Value::Unsigned(number), Value::Signed(_)) => {
            i64::try_from(*number).ok().map(Value::Signed)
        }
        (value, usual) => {
            return std::mem::discriminant(value) == std::mem::discriminant(usual);
        }
    };
    let fits = made.is_some();
    if let Some(made) = made {
        *value = made;
    }
    fits
}
