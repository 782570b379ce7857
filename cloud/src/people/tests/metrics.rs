use std::collections::BTreeMap;

use super::*;

/// Returns the samples of the text format of Prometheus, each of a family that is declared before.
fn parsed(text: &str) -> BTreeMap<String, f64> {
    let (mut samples, mut family) = (BTreeMap::new(), String::new());
    for line in text.lines() {
        let words: Vec<_> = line.splitn(4, ' ').collect();
        match words[..] {
            ["#", "HELP", name, help] => {
                assert!(name.starts_with("gleaner_cloud_") && !help.is_empty());
                family = name.to_owned();
            }
            ["#", "TYPE", name, kind] => {
                assert!(name == family && ["gauge", "counter", "summary"].contains(&kind));
                assert_eq!(kind == "counter", name.ends_with("_total"), "{name}");
            }
            [sample, value] => {
                assert!(sample.starts_with(&family), "{sample} of {family}");
                let before = samples.insert(sample.to_owned(), value.parse().unwrap());
                assert_eq!(before, None, "{sample}");
            }
            _ => panic!("`{line}` is no line of the format"),
        }
    }
    samples
}

#[tokio::test]
async fn health_is_open_and_metrics_need_a_viewer() {
    let (_folder, cloud) = Cloud::of_test().await;
    let get = async |path, token| send(&cloud, (Method::GET, path), token, &[], "").await;
    let health = get("/health", None).await.json();
    assert!(
        health["ready"] == true && health["database"] == crate::store::MIGRATIONS.len(),
        "{health}"
    );
    assert_eq!(get("/metrics", None).await.status, StatusCode::UNAUTHORIZED);
    let token = token_of(&cloud, "ann", Role::Viewer).await;
    let epoch = crate::store::tests::connected(&cloud.store, "car-7").await;
    cloud.store.disconnect("car-7", epoch).await.unwrap();
    crate::counts::COUNTS.answered(418);
    let answer = get("/metrics", Some(&token)).await;
    assert_eq!(answer.headers[header::CONTENT_TYPE], "text/plain; version=0.0.4; charset=utf-8");
    let samples = parsed(&String::from_utf8(answer.body).unwrap());
    let of = |name: &str| samples[&format!("gleaner_cloud_{name}")];
    assert_eq!((of("vehicles{state=\"offline\"}"), of("vehicles{state=\"online\"}")), (1.0, 0.0));
    assert!(of("http_answers_total{code=\"418\"}") == 1.0 && of("write_seconds_count") >= 2.0);
    assert!(of("age_lag_seconds").abs() < 600.0 && of("write_seconds_sum") > 0.0);
    cloud.store.close().await;
    // The last look at the database counts for a second.
    assert_eq!(get("/health", None).await.status, StatusCode::OK);
    *cloud.health.lock().await = None;
    let health = get("/health", None).await;
    assert_eq!((health.status.as_u16(), &health.json()["ready"]), (503, &json!(false)));
}
